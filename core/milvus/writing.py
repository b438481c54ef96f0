"""One write to a map: the changes of a transaction in PostgreSQL, and the entities for Milvus before its COMMIT."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from psycopg import Connection

from core.errors import UnknownPlace
from core.geometry.keypoints import Keypoints
from core.maps.enrolling import picture_of
from core.maps.place_filter import PlaceFilter
from core.maps.records import Change, Enrolment, History, Keep, MapRecord, PicturedPlace, SameFrame
from core.maps.stored_fields import metadata_text, same_fields
from core.maps.views import MOST_HIDDEN, LatestViews, Look, latest_views, leaves_view, reach_of
from core.milvus import ledger
from core.milvus.collection import Collection, Entity
from core.milvus.forms import Form
from core.milvus.ledger import Frame, MapState, PlaceEntry
from core.milvus.pictures.stored import StoredPicture, new_object
from core.milvus.tokens import tokens_of
from core.places import Place, PlaceFields, Pose

if TYPE_CHECKING:
    from core.milvus.pictures.objects import Objects


class Write:
    """Collects what one transaction changes of a map, whose row it has locked."""

    def __init__(
        self,
        connection: Connection[Any],
        collection: Collection,
        state: MapState,
        objects: Objects | None,
        rebuilding: bool = False,
    ) -> None:
        """Begin a write.

        Args:
            objects: where pictures are put; None: in PostgreSQL.
            rebuilding: whether entities may go to another collection than the one that has the map's so far.
        """
        self._rebuilding = rebuilding
        self.state = state
        self._objects = objects
        self._pictures: dict[str, bytes] = {}  # by the names of their objects
        self.connection, self._collection = connection, collection
        self._before, self._form = state, Form(state.record)
        self._entities: dict[int, Callable[[], Entity]] = {}  # by the number of the place
        self._changed = False
        self._latest: dict[str, LatestViews] = {}  # of the sequences that frames were added to
        self._now = datetime.now(UTC)
        self._object_key: tuple[str, int] | None = None

    def expect(self, place_id: str) -> PlaceEntry:
        """A place.

        Raises:
            UnknownPlace.
        """
        return expect_place(self.connection, self.state.number, place_id)

    def all_of(self, wanted: PlaceFilter, limit: int | None, after: int = -1) -> list[PlaceEntry]:
        """Places that fulfil some conditions, in the order of their enrolment, behind the number ``after``."""
        return ledger.entries_after(self.connection, self.state.number, after, limit, wanted)

    def enrol(self, item: Enrolment, keep: Keep | None = None, ordinal: int | None = None) -> tuple[Place, Change]:
        """Create a place, replace its frame, or change its fields if the frame is the same.

        Args:
            keep: the picture of the frame to store; by default that of the map's settings.
            ordinal: the position of a new place in its sequence; None: by its view, at the end of the sequence.
        """
        stored = ledger.find(self.connection, self.state.number, item.id)
        keypoints = None if item.keypoints is None or not self.state.record.verification else item.keypoints.record()
        if stored is not None and stored.digest == item.digest:
            if keypoints is not None:
                ledger.put_keypoints(self.connection, self.state.number, stored.row, keypoints)
            return self.set_fields(stored, item.fields)
        metadata_text(item.fields.metadata)  # raises InvalidField
        row, (kind, picture) = self.state.rows, picture_of(item, self.state.record.keep if keep is None else keep)
        descriptor, local = self._form.packed(item.descriptor, item.local)
        frame = Frame(descriptor, local, keypoints, self.stored_picture(picture))
        ledger.put_frame(self.connection, self.state.number, row, frame)
        self.state = replace(self.state, rows=row + 1)
        place = Place(
            **dict(item.fields), id=item.id, regions=item.regions, picture=kind,
            created_at=self._now if stored is None else stored.place.created_at, updated_at=self._now,
        )  # fmt: skip
        look = Look(item.descriptor, item.local, item.fields.pose)
        if stored is None:
            at = self._position(place.sequence, look) if ordinal is None else ordinal
            code, at = ledger.next_in_sequence(self.connection, self.state.number, place.sequence, at)
            entry = PlaceEntry(self.new_key(), row, self.new_key(), item.digest, code, at, place)
            self.state = replace(self.state, places=self.state.places + 1)
            self._put(entry, descriptor)
            if (views := self._latest.get(place.sequence or "")) is not None:
                views.note(at, look)
            return place, "created"
        shown = replace(self._placed(stored, place, look), row=row, digest=item.digest, track=None, station=None)
        self._put(shown, descriptor)
        self._let_go(stored, stored.row)
        return place, "replaced"

    def _position(self, sequence: str | None, look: Look) -> int | None:
        """The position at the end of a sequence of a frame that shows a view which is there already, else None."""
        if sequence is None:
            return None
        if sequence not in self._latest:
            positions = min(self.state.record.same_place_frames, MOST_HIDDEN)
            last, first = ledger.latest_in_sequence(self.connection, self.state.number, sequence, positions)
            self._latest[sequence] = latest_views(last, first, positions, self._reach, self._looks)
        return self._latest[sequence].position_of(look)

    def _looks(self, rows: list[int]) -> list[Look]:
        """The content of the frames in some rows."""
        number = self.state.number
        descriptors = ledger.of_frames(self.connection, number, "descriptor", rows)
        local = ledger.of_frames(self.connection, number, "local", rows)
        poses = {entry.row: entry.place.pose for entry in ledger.entries_by(self.connection, number, "row", rows)}
        return [
            Look(self._form.descriptors([descriptors[row]])[0], self._form.locals([local[row]])[0], poses[row])
            for row in rows
        ]

    def renew(self, item: SameFrame) -> tuple[Place, Change] | None:
        """Change the fields of a place that shows this frame; None if it shows another frame or is gone."""
        stored = ledger.find(self.connection, self.state.number, item.id)
        return None if stored is None or stored.digest != item.digest else self.set_fields(stored, item.fields)

    def set_fields(self, stored: PlaceEntry, fields: PlaceFields) -> tuple[Place, Change]:
        """Change the fields of a place; its frame stays."""
        if same_fields(stored.place, fields):
            return stored.place, "unchanged"
        changed = {name: getattr(fields, name) for name in PlaceFields.model_fields}
        if fields.pose != stored.place.pose:
            changed["pose_of"] = None
        place = stored.place.model_copy(update={**changed, "updated_at": self._now})
        self._put(self._placed(stored, place), self._stored_descriptor(stored))
        self._let_go(stored, None)
        return place, "updated"

    def _stored_descriptor(self, stored: PlaceEntry) -> bytes:
        descriptor: bytes = ledger.of_frames(self.connection, self.state.number, "descriptor", [stored.row])[stored.row]
        return descriptor

    def renew_entity(self, stored: PlaceEntry) -> None:
        """Give Milvus the entity of a place again."""
        if stored.number not in self._entities:
            self._put(replace(stored, key=self.new_key()), self._stored_descriptor(stored))
            self._let_go(stored, None)

    def adopt(self, item: Enrolment, history: History) -> None:
        """Store a place of another map with its history."""
        self.enrol(item, history.picture, history.ordinal)
        self._latest.clear()
        stored = self.expect(item.id)
        moments = {"created_at": history.created_at, "updated_at": history.updated_at}
        ordinal = stored.ordinal if history.ordinal is None else history.ordinal
        changed = replace(stored, place=stored.place.model_copy(update=moments), ordinal=ordinal)
        if stored.number in self._entities:  # Milvus does not have it yet
            self._put(changed, self._stored_descriptor(stored))
        elif ordinal == stored.ordinal:
            ledger.put(self.connection, self.state.number, changed)
            self._changed = True
        else:
            self._put(replace(changed, key=self.new_key()), self._stored_descriptor(stored))
            self._let_go(stored, None)
        ledger.put_ordinal(self.connection, self.state.number, stored.sequence, max(ordinal, history.behind - 1))

    def set_counterpart(
        self, stored: PlaceEntry, track: int | None, station: int | None, pose: Pose | None, pose_of: str | None
    ) -> None:
        """Set the station of a place, None for its own, its pose and the place from which it got the pose."""
        if (track, station) == (stored.sequence, stored.ordinal):
            track = station = None
        fields: dict[str, Any] = {"pose_of": pose_of}
        if pose != stored.place.pose:
            fields |= {"pose": pose, "updated_at": self._now}
        place = stored.place.model_copy(update=fields)
        changed = replace(stored, track=track, station=station, place=place)
        if pose == stored.place.pose:  # Milvus knows nothing of stations
            ledger.put(self.connection, self.state.number, changed)
            self._changed = True
        else:
            self._put(replace(changed, key=self.new_key()), self._stored_descriptor(stored))
            self._let_go(stored, None)

    def add_keypoints(self, frame: PicturedPlace, found: Keypoints) -> bool:
        """Store the keypoints of a place that has none, if it still shows the frame; returns whether it does."""
        stored = ledger.find(self.connection, self.state.number, frame.id)
        if stored is None or stored.digest != frame.digest or not self.state.record.verification:
            return False
        self._changed = True
        return ledger.put_keypoints(self.connection, self.state.number, stored.row, found.record())

    def _placed(self, stored: PlaceEntry, place: Place, look: Look | None = None) -> PlaceEntry:
        """A place with other fields, under a new key; its position in its sequence changes only with the sequence.

        Args:
            look: the look of its new frame; None: its frame stays.
        """
        code, ordinal = stored.sequence, stored.ordinal
        if place.sequence != stored.place.sequence or self._leaves(stored, place, look):
            at = self._position(place.sequence, look or replace(self._looks([stored.row])[0], pose=place.pose))
            code, ordinal = ledger.next_in_sequence(self.connection, self.state.number, place.sequence, at)
        self._latest.clear()
        return replace(stored, key=self.new_key(), sequence=code, ordinal=ordinal, place=place)

    def _leaves(self, stored: PlaceEntry, place: Place, look: Look | None) -> bool:
        """Whether a place whose sequence stays does not belong to its position any more, because of a change."""
        if place.sequence is None or (look is None and place.pose == stored.place.pose):
            return False
        number = self.state.number
        first = ledger.first_at(self.connection, number, stored.sequence, stored.ordinal, before=stored.number)
        if first is None:
            return False
        rows = [] if look is None else ledger.beside(self.connection, number, stored)
        began, *others = self._looks([first, *rows])
        return leaves_view(place.pose, look, began, others, self._reach)

    @property
    def _reach(self) -> float:
        return reach_of(self.state.record.same_place_radius)

    def forget(self, stored: PlaceEntry) -> None:
        """Delete a place."""
        ledger.remove(self.connection, self.state.number, stored)
        self._latest.clear()
        self._entities.pop(stored.number, None)
        self.state = replace(self.state, places=self.state.places - 1)
        self._let_go(stored, stored.row)

    def edit(self, record: MapRecord) -> None:
        """Replace the map's record, with the next revision."""
        changed = {"revision": self.state.record.revision + 1, "updated_at": self._now}
        self.state = replace(self.state, record=record.model_copy(update=changed))

    def move(self) -> None:
        """Note that all entities of the map are in Milvus's present collection."""
        self.state = replace(self.state, collection=self._collection.id)

    def new_key(self) -> int:
        """A number that was never used before."""
        return ledger.new_key(self.connection)

    def _put(self, entry: PlaceEntry, descriptor: bytes) -> None:
        ledger.put(self.connection, self.state.number, entry)
        camera, tokens = entry.place.camera, tokens_of(entry.place.metadata)
        self._entities[entry.number] = lambda: Entity(
            entry.key, entry.row, self._form.descriptors([descriptor])[0], entry.whereabouts(), camera, tokens
        )

    def put_new(self, entry: PlaceEntry, frame: Frame) -> None:
        """Store a place that is not there yet, and its frame in the next row."""
        ledger.put_frame(self.connection, self.state.number, entry.row, frame)
        self.state = replace(self.state, rows=entry.row + 1, places=self.state.places + 1)
        self._put(entry, frame.descriptor)

    def stored_picture(self, picture: bytes | None) -> StoredPicture:
        """A picture as its row has it; an object is stored at the end of the write."""
        if picture is None or self._objects is None:
            return picture
        if self._object_key is None:
            self._object_key = ledger.new_object_key(self.connection)
        made = new_object(*self._object_key, picture)
        self._pictures[made.name] = picture
        return made

    def _let_go(self, stored: PlaceEntry, row: int | None) -> None:
        """Note that a place's former entity, and its former frame, are not used any more."""
        ledger.leave(self.connection, self.state.number, stored.key, row)
        ledger.drop_if_empty(self.connection, self.state.number, stored.sequence)

    def finish(self) -> None:
        """Give the object store and Milvus what is new, before the COMMIT that makes it count.

        Raises:
            StorageFull, StorageFailure: one of them refuses; nothing counts of what they may have taken.
        """
        if self._objects is None or not self._pictures:
            self._insert()
            return
        try:
            self._objects.put(self._pictures)
            self._insert()
        except BaseException:
            self._objects.discard(list(self._pictures))
            raise

    def _insert(self) -> None:
        if self._entities:
            if not self._rebuilding:
                self._collection.expect(self.state.collection)
                self.state = replace(self.state, collection=self._collection.id)
            inserted = self._collection.insert(self.state.number, [made() for made in self._entities.values()])
            self.state = replace(self.state, inserted=max(self.state.inserted, inserted))
        if self.state != self._before or self._entities or self._changed:
            self.state = replace(self.state, writes=self.state.writes + 1)
            ledger.update(self.connection, self.state)


def expect_place(connection: Connection[Any], map_number: int, place_id: str) -> PlaceEntry:
    """The place of this id.

    Raises:
        UnknownPlace: there is none.
    """
    entry = ledger.find(connection, map_number, place_id)
    if entry is None:
        raise UnknownPlace(f"The map has no place {place_id[:140]!r}.")
    return entry
