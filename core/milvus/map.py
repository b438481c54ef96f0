"""One map in PostgreSQL and Milvus."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, overload

import numpy as np
from psycopg import Connection

from core.errors import (
    InvalidKeypoints,
    RevisionMismatch,
    StorageFailure,
    TooManyToForget,
    UnknownPlace,
    UnknownSequence,
)
from core.geometry.keypoints import Keypoints, keypoints_of
from core.maps.place_filter import EVERY_PLACE, PlaceFilter
from core.maps.records import Change, Enrolment, MapRecord, Outline, SameFrame, patched_fields, patched_record
from core.maps.selection import Selection
from core.milvus import ledger
from core.milvus.cameras import MilvusCameras
from core.milvus.collection import Collection, Entity
from core.milvus.database import Database
from core.milvus.ledger import Frame, MapState, PlaceEntry
from core.milvus.snapshot import MilvusScope, MilvusSnapshot, scope_of
from core.milvus.tokens import tokens_of
from core.places import Place, PlaceFields
from core.storage.database.ledger import metadata_text, picture_of, same_fields
from core.storage.pagination import decode_number, listing_of_places, one_more, page_of
from core.storage.writing import check_enrolment

log = logging.getLogger(__name__)


class MilvusMap:
    """The places of one environment.  Any thread of any process may call any method.

    One transaction writes to a map at a time.  Any method may raise StorageFailure (PostgreSQL or Milvus refuses, or
    cannot be reached) and UnknownMap; methods that write may also raise StorageFull.
    """

    def __init__(self, database: Database, collection: Collection, state: MapState) -> None:
        """The map that was found in this state."""
        self._database, self.collection, self._state = database, collection, state
        self.cameras = MilvusCameras(state.number, self._reading, self._locked)

    @property
    def record(self) -> MapRecord:
        """The map's record as it was when this object last read or wrote the map."""
        return self._state.record

    @property
    def transfer(self) -> MilvusMap:
        """Lists all places in brief."""
        return self

    @property
    def _number(self) -> int:
        return self._state.number

    @contextmanager
    def _reading(self) -> Iterator[Connection[Any]]:
        with self._database.reading() as connection:
            self._state = ledger.state_of(connection, self.record.id, self._number)
            yield connection

    # Searching

    def snapshot(self) -> MilvusSnapshot:
        """All places at this moment."""
        with self._reading() as connection:
            return self._snapshot(connection)

    def _snapshot(self, connection: Connection[Any]) -> MilvusSnapshot:
        leavings = tuple(ledger.leavings(connection, self._number))
        return MilvusSnapshot(self._database, self.collection, self._state, leavings)

    def scope(self, selection: Selection | None = None) -> MilvusScope:
        """The places that a query may find at this moment; None: all."""
        with self._reading() as connection:
            return scope_of(connection, self._snapshot(connection), selection)

    def places_at(self, rows: Sequence[int]) -> list[Place | None]:
        """The places of rows that a search returned; None where a place was deleted or got another frame since."""
        with self._reading() as connection:
            entries = ledger.entries_by(connection, self._number, "row", [int(row) for row in rows])
        found = {entry.row: entry.place for entry in entries}
        return [found.get(int(row)) for row in rows]

    def keypoints_at(self, rows: Sequence[int]) -> list[Keypoints | None]:
        """The keypoints of those places; None also where none are kept, and where they are damaged, which is logged."""
        with self._reading() as connection:
            entries = ledger.entries_by(connection, self._number, "row", [int(row) for row in rows])
            kept = ledger.of_frames(connection, self._number, "keypoints", [entry.row for entry in entries])
        return [None if (record := kept.get(int(row))) is None else _keypoints(int(row), record) for row in rows]

    def rows_of(self, place_ids: Sequence[str]) -> list[int | None]:
        """The rows of places; None where there is no such place."""
        with self._reading() as connection:
            entries = ledger.entries_by(connection, self._number, "id", place_ids)
        found = {entry.place.id: entry.row for entry in entries}
        return [found.get(place_id) for place_id in place_ids]

    # Reading

    def count_places(self) -> int:
        """How many places the map has."""
        with self._reading():
            return self._state.places

    def place(self, place_id: str) -> Place:
        """One place.

        Raises:
            UnknownPlace.
        """
        with self._reading() as connection:
            return _expect(connection, self._number, place_id).place

    def places(
        self, cursor: str | None, limit: int, wanted: PlaceFilter = EVERY_PLACE
    ) -> tuple[list[Place], str | None]:
        """A page of places in the order of their enrolment, and the cursor of the next page.

        Raises:
            InvalidCursor.
        """
        most = one_more(limit)
        listing = listing_of_places(self.record.id, wanted)
        after = decode_number(listing, cursor)
        with self._reading() as connection:
            found = ledger.entries_after(connection, self._number, after, most, wanted)
        page, more = page_of(listing, found, limit, lambda entry: entry.number)
        return [entry.place for entry in page], more

    def outline(self) -> list[Outline]:
        """All places in brief, in the order of their enrolment."""
        with self._reading() as connection:
            entries = ledger.entries_after(connection, self._number, -1, None, EVERY_PLACE)
        return [entry.outline() for entry in entries]

    def picture(self, place_id: str) -> bytes | None:
        """The picture kept of a place's frame, as the place's ``picture`` says; None if it is gone or keeps none."""
        with self._reading() as connection:
            entry = ledger.find(connection, self._number, place_id)
            if entry is None:
                return None
            found: bytes | None = ledger.of_frames(connection, self._number, "picture", [entry.row]).get(entry.row)
            return found

    # Writing

    @contextmanager
    def _locked(self) -> Iterator[Connection[Any]]:
        with self._database.transaction("write to a map") as connection:
            self._state = ledger.state_of(connection, self.record.id, self._number, locked=True)
            yield connection

    @contextmanager
    def _writing(self) -> Iterator[Write]:
        with self._locked() as connection:
            write = Write(connection, self.collection, self._state)
            yield write
            write.finish()
        self._state = write.state
        self._tidy()

    def _tidy(self) -> None:
        """Delete what was left over a while ago; what cannot be deleted now is deleted after another write."""
        try:
            with self._database.transaction("delete what is left over") as connection:
                if keys := ledger.old_leavings(connection, self._number):
                    self.collection.delete(keys)
                    ledger.clear(connection, self._number, keys)
        except StorageFailure as error:
            log.warning("Map %s: %s", self.record.id, error)

    def edit(self, changes: Mapping[str, Any], expected_revision: int | None = None) -> MapRecord:
        """Change settings or the calibration; the revision grows by one if anything changes.

        Raises:
            InvalidField: a field is unknown or fixed, or its value is not allowed.
            RevisionMismatch: the record is not at ``expected_revision``.
        """
        with self._writing() as write:
            record = write.state.record
            if expected_revision is not None and expected_revision != record.revision:
                raise RevisionMismatch(f"The map is at revision {record.revision}, not {expected_revision}.")
            changed = patched_record(record, changes)
            if changed != record:
                write.edit(changed)
        return write.state.record

    @overload
    def enrol(self, items: Sequence[Enrolment]) -> Sequence[tuple[Place, Change]]: ...

    @overload
    def enrol(self, items: Sequence[Enrolment | SameFrame]) -> Sequence[tuple[Place, Change] | None]: ...

    def enrol(self, items: Sequence[Enrolment | SameFrame]) -> Sequence[tuple[Place, Change] | None]:
        """Store frames as places in the order given, in one transaction (:meth:`core.maps.store.Map.enrol`).

        Raises:
            InvalidIdentifier, InvalidField: an id or metadata that cannot be stored.
            NoRegions: a descriptor is all zero.
            ValueError: descriptors or a digest of the wrong kind.
        """
        for item in items:
            if isinstance(item, Enrolment):
                check_enrolment(item, self.record.dimension, self.record.local_shape)
        if not items:
            return []
        with self._writing() as write:
            return [write.enrol(item) if isinstance(item, Enrolment) else write.renew(item) for item in items]

    def set_fields(self, place_id: str, fields: PlaceFields) -> tuple[Place, Change]:
        """Replace all fields of a place; its frame stays.

        Raises:
            UnknownPlace, InvalidField.
        """
        with self._writing() as write:
            return write.set_fields(write.expect(place_id), fields)

    def patch(self, place_id: str, changes: Mapping[str, Any]) -> Place:
        """Apply a merge patch (RFC 7396) to pose, timestamp, sequence and metadata.

        Raises:
            UnknownPlace, InvalidField.
        """
        with self._writing() as write:
            entry = write.expect(place_id)
            return write.set_fields(entry, patched_fields(entry.place, changes))[0]

    def forget(self, place_id: str) -> None:
        """Delete a place.

        Raises:
            UnknownPlace.
        """
        with self._writing() as write:
            write.forget(write.expect(place_id))

    def forget_all(self, wanted: PlaceFilter, most: int) -> list[str]:
        """Delete the places that fulfil some conditions, all or none; returns their ids.

        Raises:
            TooManyToForget: there are more than ``most``.
        """
        with self._writing() as write:
            found = write.all_of(wanted, most + 1)
            if len(found) > most:
                raise TooManyToForget(
                    f"More than {most} places fulfil the conditions. Forget them in several requests."
                )
            for entry in found:
                write.forget(entry)
        return [entry.place.id for entry in found]

    def forget_sequence(self, name: str) -> int:
        """Delete all places of a sequence; returns how many.

        Raises:
            UnknownSequence: there is none.
        """
        with self._writing() as write:
            found = write.all_of(PlaceFilter(sequence=name), None)
            if not found:
                raise UnknownSequence(f"The map has no sequence {name[:128]!r}.")
            for entry in found:
                write.forget(entry)
        return len(found)


class Write:
    """Collects what one transaction changes of a map, whose row it has locked."""

    def __init__(self, connection: Connection[Any], collection: Collection, state: MapState) -> None:
        self.state = state
        self._connection, self._collection = connection, collection
        self._before = state
        self._entities: dict[int, Callable[[], Entity]] = {}  # by the number of the place
        self._now = datetime.now(UTC)

    def expect(self, place_id: str) -> PlaceEntry:
        """A place.

        Raises:
            UnknownPlace.
        """
        return _expect(self._connection, self.state.number, place_id)

    def all_of(self, wanted: PlaceFilter, limit: int | None) -> list[PlaceEntry]:
        """Places that fulfil some conditions, in the order of their enrolment."""
        return ledger.entries_after(self._connection, self.state.number, -1, limit, wanted)

    def enrol(self, item: Enrolment) -> tuple[Place, Change]:
        """Create a place, replace its frame, or change its fields if the frame is the same."""
        stored = ledger.find(self._connection, self.state.number, item.id)
        keypoints = None if item.keypoints is None or not self.state.record.verification else item.keypoints.record()
        if stored is not None and stored.digest == item.digest:
            if keypoints is not None:
                ledger.put_keypoints(self._connection, self.state.number, stored.row, keypoints)
            return self.set_fields(stored, item.fields)
        metadata_text(item.fields.metadata)  # raises InvalidField
        row, kept = self.state.rows, picture_of(item, self.state.record.keep)
        halves = item.descriptor.astype("<f2")
        frame = Frame(halves.tobytes(), item.local.tobytes(), keypoints, kept[1])
        ledger.put_frame(self._connection, self.state.number, row, frame)
        self.state = replace(self.state, rows=row + 1)
        place = Place(
            **dict(item.fields), id=item.id, regions=item.regions, picture=kept[0],
            created_at=self._now if stored is None else stored.place.created_at, updated_at=self._now,
        )  # fmt: skip
        if stored is None:
            code, ordinal = ledger.next_in_sequence(self._connection, self.state.number, place.sequence)
            entry = PlaceEntry(self._new_key(), row, self._new_key(), item.digest, code, ordinal, place)
            self.state = replace(self.state, places=self.state.places + 1)
            self._put(entry, halves.astype(np.float32))
            return place, "created"
        self._put(replace(self._placed(stored, place), row=row, digest=item.digest), halves.astype(np.float32))
        self._let_go(stored, stored.row)
        return place, "replaced"

    def renew(self, item: SameFrame) -> tuple[Place, Change] | None:
        """Change the fields of a place that shows this frame; None if it shows another frame or is gone."""
        stored = ledger.find(self._connection, self.state.number, item.id)
        return None if stored is None or stored.digest != item.digest else self.set_fields(stored, item.fields)

    def set_fields(self, stored: PlaceEntry, fields: PlaceFields) -> tuple[Place, Change]:
        """Change the fields of a place; its frame stays."""
        if same_fields(stored.place, fields):
            return stored.place, "unchanged"
        changed = {name: getattr(fields, name) for name in PlaceFields.model_fields}
        if fields.pose != stored.place.pose:
            changed["pose_of"] = None
        place = stored.place.model_copy(update={**changed, "updated_at": self._now})
        kept = ledger.of_frames(self._connection, self.state.number, "descriptor", [stored.row])[stored.row]
        self._put(self._placed(stored, place), np.frombuffer(kept, "<f2").astype(np.float32))
        self._let_go(stored, None)
        return place, "updated"

    def _placed(self, stored: PlaceEntry, place: Place) -> PlaceEntry:
        """A place with other fields, under a new key; its position in its sequence changes only with the sequence."""
        code, ordinal = stored.sequence, stored.ordinal
        if place.sequence != stored.place.sequence:
            code, ordinal = ledger.next_in_sequence(self._connection, self.state.number, place.sequence)
        return replace(stored, key=self._new_key(), sequence=code, ordinal=ordinal, place=place)

    def forget(self, stored: PlaceEntry) -> None:
        """Delete a place."""
        ledger.remove(self._connection, self.state.number, stored)
        self._entities.pop(stored.number, None)
        self.state = replace(self.state, places=self.state.places - 1)
        self._let_go(stored, stored.row)

    def edit(self, record: MapRecord) -> None:
        """Replace the map's record, with the next revision."""
        changed = {"revision": self.state.record.revision + 1, "updated_at": self._now}
        self.state = replace(self.state, record=record.model_copy(update=changed))

    def _new_key(self) -> int:
        return ledger.new_key(self._connection)

    def _put(self, entry: PlaceEntry, descriptor: np.ndarray[Any, np.dtype[np.float32]]) -> None:
        ledger.put(self._connection, self.state.number, entry)
        camera, tokens = entry.place.camera, tokens_of(entry.place.metadata)
        self._entities[entry.number] = lambda: Entity(
            entry.key, entry.row, descriptor, entry.whereabouts(), camera, tokens
        )

    def _let_go(self, stored: PlaceEntry, row: int | None) -> None:
        """Note that a place's former entity, and its former frame, are not used any more."""
        ledger.leave(self._connection, self.state.number, stored.key, row)
        ledger.drop_if_empty(self._connection, self.state.number, stored.sequence)

    def finish(self) -> None:
        """Give Milvus what is new, before the COMMIT that makes it count.

        Raises:
            StorageFailure: Milvus refuses; nothing counts of what it may have taken.
        """
        if self._entities:
            inserted = self._collection.insert(self.state.number, [made() for made in self._entities.values()])
            self.state = replace(self.state, inserted=max(self.state.inserted, inserted))
        if self.state != self._before or self._entities:
            self.state = replace(self.state, writes=self.state.writes + 1)
            ledger.update(self._connection, self.state)


def _expect(connection: Connection[Any], map_number: int, place_id: str) -> PlaceEntry:
    entry = ledger.find(connection, map_number, place_id)
    if entry is None:
        raise UnknownPlace(f"The map has no place {place_id[:140]!r}.")
    return entry


def _keypoints(row: int, record: bytes) -> Keypoints | None:
    try:
        return keypoints_of(record)
    except InvalidKeypoints as error:
        log.error("The keypoints of row %d are damaged: %s", row, error)
        return None
