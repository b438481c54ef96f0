"""One write to a map: places with all that is stored of their frames, and sequences."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.errors import LookNameTaken, RepeatedLook, TooManyLooks, UnknownPlace
from core.geometry.keypoints import Keypoints
from core.index import Coder
from core.ledger.maps import frames, places, record, rows, sequences
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.places import StoredPlace
from core.ledger.maps.record import MapState
from core.maps.enrolling import picture_of
from core.maps.forms import Form
from core.maps.records import (
    COMPACT_FROM,
    MOST_LOOKS,
    Change,
    Enrolment,
    History,
    Keep,
    MapRecord,
    PicturedPlace,
    SameFrame,
)
from core.maps.stored_fields import moment_text, same_fields
from core.maps.views import MOST_HIDDEN, LatestViews, ViewedFrame, latest_views, leaves_view, reach_of
from core.places import NO_SEQUENCE, Place, PlaceFields, Pose, PoseKind, check_coordinates, place_and_look

Descriptors = tuple[NDArray[np.float32], NDArray[np.int8]]
"""The descriptor, float32 [D], and the local descriptors, int8 [C, L], of one frame."""


class Write:
    """Collects the changes of one write within a transaction; ``finish`` comes before its COMMIT.

    New places, pictures and keypoints are stored many at a time: when something else is to be read or written, and at
    the end.

    state: of the map, with the changes so far.
    changed: whether anything was changed, the counters apart.
    leaves: whether a row is no place's any more.
    """

    def __init__(self, connection: MapConnection, state: MapState) -> None:
        self._connection, self.state, self.changed, self.leaves = connection, state, False, False
        self._form = Form.of(state.record)
        self._new: dict[int, tuple[bytes, bytes]] = {}  # descriptor and local descriptors by row, in stored form
        self._before = state
        self._found: dict[str, StoredPlace | None] = {}  # by id, as they are now
        self._codes: dict[str, int] = {}  # of sequences
        self._ordinals: dict[int, int] = {}  # the next of each sequence, that is not stored yet
        self._places: list[StoredPlace] = []
        self._pictures_by_row: dict[int, bytes] = {}
        self._keypoints: dict[int, tuple[bytes, bytes]] = {}  # digest of the frame and record, by row
        self._latest: dict[str, LatestViews] = {}  # of the sequences that frames were added to
        self._kinds: set[PoseKind] = set()  # of the poses that places may get, as far as was looked up
        self._now = datetime.now(UTC)

    @property
    def connection(self) -> MapConnection:
        """The connection of the transaction, in which nobody else writes to the map and all changes so far show."""
        self._store_waiting()
        return self._connection

    def _store_waiting(self) -> None:
        """Store what waits to be stored."""
        connection = self._connection
        if self._places:
            waiting, self._places = self._places, []
            places.insert(connection, waiting)
        if self._pictures_by_row:
            pictures, self._pictures_by_row = self._pictures_by_row, {}
            frames.put_pictures(connection, pictures)
        if self._keypoints:
            keypoints, self._keypoints = self._keypoints, {}
            frames.put_keypoints(connection, keypoints)
        ordinals, self._ordinals = self._ordinals, {}
        for code, following in ordinals.items():
            sequences.keep_free(connection, code, following)

    def add_stored(self, frame: NDArray[np.void]) -> int:
        """Take the next row's descriptors as an export file has them (``core.maps.forms.Form.frame``); the row."""
        row = self.state.rows
        self._new[row] = self._form.divided(frame.tobytes())
        self.state = replace(self.state, rows=row + 1)
        return row

    def _descriptors_at(self, wanted: Sequence[int]) -> list[Descriptors]:
        """The descriptors of rows, those of this write included."""
        old = [row for row in wanted if row not in self._new]
        descriptors, local = (rows.at(self.connection, kind, old) if old else {} for kind in rows.OF_FRAMES)
        stored = [self._new.get(row) or (descriptors[row], local[row]) for row in wanted]
        unpacked = self._form.descriptors([one for one, _ in stored]), self._form.locals([one for _, one in stored])
        return list(zip(*unpacked, strict=True))

    # Changes

    @property
    def record(self) -> MapRecord:
        """The map's record."""
        return self.state.record

    def look_for(self, place_ids: Sequence[str]) -> None:
        """Read the places of some ids at once, which are enrolled next."""
        found = places.of_ids(self.connection, place_ids)
        self._found.update({place_id: found.get(place_id) for place_id in place_ids})

    def find(self, place_id: str) -> StoredPlace | None:
        """The place of an id, or the look of an address, with the changes so far; None if there is none."""
        if place_id not in self._found:
            self._found[place_id] = places.find(self.connection, place_id)
        return self._found[place_id]

    def enrol(self, item: Enrolment, keep: Keep | None = None, ordinal: int | None = None) -> tuple[Place, Change]:
        """Create a place, replace its frame, or change its fields if the frame is the same; or add a look to a place.

        A place whose frame is replaced loses the looks that were learnt, for it may be another place now, and a look
        that shows the new frame.

        Args:
            keep: the picture of the frame to store; by default that of the map's settings.
            ordinal: the position of a new place in its sequence; None: by its view, at the end of the sequence.

        Raises:
            MixedCoordinates: its pose is of the kind that the map's places do not have; nothing was changed.
            UnknownPlace, RepeatedLook, LookNameTaken, TooManyLooks.
        """
        of, name = place_and_look(item.id)
        stored, place = self.find(item.id), None if name is None else self.find(of)
        if stored is not None and stored.digest == item.digest:
            if item.keypoints is not None and not frames.has_keypoints(self.connection, stored.row):
                self._put_keypoints(stored, item.keypoints)
            return self.set_fields(stored, item.fields) if name is None else (stored.shown(), "unchanged")
        if name is not None:
            if stored is not None:
                raise LookNameTaken(f"Another frame of place {of!r} is its look {name}.")
            place = self._expect_room_for_look(of, item.digest)
        if name is None:
            self._expect_coordinates(item.id, item.fields.pose, stored)
        row, (kind, picture) = self.state.rows, picture_of(item, self.record.keep if keep is None else keep)
        self._new[row] = self._form.packed(item.descriptor, item.local)
        self.state = replace(self.state, rows=row + 1)
        least = None if item.least is None else item.least + 0.0
        frame: dict[str, Any] = {"row": row, "digest": item.digest, "run": item.run, "least": least}
        shape: dict[str, Any] = {**frame, "regions": item.regions, "picture": kind}
        look = ViewedFrame(item.descriptor, item.local, item.fields.pose)
        if place is not None:
            made = self._create_look(place, item, shape)
        elif stored is None:
            made = self._create(item, shape, look, ordinal)
        else:
            shown = places.with_place(stored, regions=item.regions, picture=kind, pose_of=None)
            shown = replace(shown, track=None, station=None, **frame)
            made = self._put(self._with_fields(shown, item.fields, look, stored), stored)
            self._leave(stored)
            made = self._without_void_looks(made)
        if picture is not None:
            self.put_picture(row, picture)
        if item.keypoints is not None:
            self._put_keypoints(made, item.keypoints)
        return made.shown(), "created" if stored is None else "replaced"

    def _expect_coordinates(self, place_id: str, pose: Pose | None, stored: StoredPlace | None) -> None:
        """Check that the pose of a place is of the kind that those of the others are.

        Args:
            stored: the place as it is; None: it is new.

        Raises:
            MixedCoordinates: it is of the other kind.
        """
        if pose is None or pose.kind() in self._kinds:
            return
        kind = pose.kind()
        if stored is not None and stored.place.pose is not None and stored.place.pose.kind() == kind:
            return
        but = places.NO_PLACE if stored is None else stored.number
        known = places.kinds_of_poses(self.connection, kind, but, self.state.posed)
        check_coordinates(known, kind, f"The pose of place {place_id!r}")
        self._kinds = {*known, kind}
        self.state = replace(self.state, posed=self.state.numbers if stored is None else stored.number)

    def _expect_room_for_look(self, place_id: str, digest: bytes) -> StoredPlace:
        """The place that a new look is of.

        Raises:
            UnknownPlace: there is none.
            RepeatedLook: the frame is the one with which the place was enrolled.
            TooManyLooks: the place has as many as it may have.
        """
        place = self.find(place_id)
        if place is None:
            raise UnknownPlace(f"The map has no place {place_id[:140]!r}.")
        if place.digest == digest:
            raise RepeatedLook(f"The frame is the one with which place {place_id!r} was enrolled.")
        if place.place.looks >= MOST_LOOKS:
            raise TooManyLooks(f"Place {place_id!r} has {MOST_LOOKS} looks already; remove one first.")
        return place

    def _create_look(self, place: StoredPlace, item: Enrolment, values: dict[str, Any]) -> StoredPlace:
        """Store a new look of a place, whose fields it has; camera and time are those of its own frame."""
        fields, now = place.place.fields().model_copy(update={"camera": item.fields.camera}), moment_text(self._now)
        seen = item.fields.timestamp
        look = places.placed(
            item.id, fields, place.sequence, place.ordinal, number=self.state.numbers, revision=self._revision,
            created_at=now, updated_at=now, seen=None if seen is None else moment_text(seen), **values,
        )  # fmt: skip
        return self.insert_look(place, places.as_look(look, place))

    def insert_look(self, place: StoredPlace, look: StoredPlace) -> StoredPlace:
        """Store a new look of a place, whose row counts already."""
        made = self.insert(look)
        now = self.find(place.place.id) or place
        self._put(places.with_place(now, looks=now.place.looks + 1), now)
        return made

    def _without_void_looks(self, stored: StoredPlace) -> StoredPlace:
        """A place with a new frame, after the looks that were learnt from runs, or show this frame, are deleted."""
        for look in places.looks_of(self.connection, stored):
            if look.run is not None or look.digest == stored.digest:
                self.forget(look)
        return self.find(stored.place.id) or stored

    def _create(self, item: Enrolment, values: dict[str, Any], look: ViewedFrame, ordinal: int | None) -> StoredPlace:
        code, at = self._code_of(item.fields.sequence), ordinal
        if at is None:
            at = self._position(item.fields.sequence, look)
        if at is None:
            at = self._next_ordinal(code)
        now = moment_text(self._now)
        made = places.placed(
            item.id, item.fields, code, at, number=self.state.numbers, revision=self._revision,
            created_at=now, updated_at=now, **values,
        )  # fmt: skip
        made = self.insert(made)
        if (views := self._latest.get(item.fields.sequence or "")) is not None:
            views.note(at, look)
        return made

    def insert(self, stored: StoredPlace) -> StoredPlace:
        """Store a new place, whose row counts already."""
        self._places.append(stored)
        self._found[stored.place.id] = stored
        self.state = replace(self.state, numbers=stored.number + 1)
        self._count(stored, 1)
        return stored

    def _count(self, stored: StoredPlace, more: int) -> None:
        """Count a place or a look that comes or, with -1, goes."""
        if stored.look_of is None:
            self.state = replace(self.state, places=self.state.places + more)
        else:
            self.state = replace(self.state, looks=self.state.looks + more)

    def _put(self, stored: StoredPlace, before: StoredPlace) -> StoredPlace:
        made = replace(stored, revision=self._revision)
        places.put(self.connection, made, before)
        self._found[made.place.id] = made
        if made.sequence != before.sequence:
            self._drop_if_empty(before.sequence)
        self.changed = True
        for look in places.looks_of(self.connection, made):
            if (moved := places.as_look(look, made)) != look:
                self._put(moved, look)
        return made

    def _code_of(self, sequence: str | None) -> int:
        """The code of a sequence, which is made if there is none."""
        if sequence is None:
            return NO_SEQUENCE
        if sequence not in self._codes:
            self._codes[sequence] = sequences.code_of(self._connection, sequence)
        return self._codes[sequence]

    def _next_ordinal(self, code: int) -> int:
        """The ordinal of the next place of a sequence, which counts as taken."""
        if code not in self._ordinals:
            self._ordinals[code] = sequences.next_ordinal(self._connection, code)
        ordinal = self._ordinals[code]
        self._ordinals[code] = ordinal + 1
        return ordinal

    def _drop_if_empty(self, code: int) -> None:
        sequences.drop_if_empty(self.connection, code)
        self._codes.clear()

    @property
    def _revision(self) -> int:
        """The revision that the map is going to have."""
        return self._before.revision + 1

    def _leave(self, stored: StoredPlace) -> None:
        """Note that the row of a place, as it was, is no place's any more."""
        self.changed = self.leaves = True
        rows.leave(self.connection, stored.row, self._revision)

    def _position(self, sequence: str | None, look: ViewedFrame) -> int | None:
        """The position at the end of a sequence of a frame that shows a view which is there already, else None."""
        if sequence is None:
            return None
        if sequence not in self._latest:
            positions = min(self.record.same_place_frames, MOST_HIDDEN)
            last, first = sequences.latest(self.connection, sequence, positions)
            self._latest[sequence] = latest_views(last, first, positions, self._reach, self._looks)
        return self._latest[sequence].position_of(look)

    def _looks(self, shown: list[int]) -> list[ViewedFrame]:
        """The content of the frames in some rows, those of this write included."""
        poses = {row: stored.place.pose for row, stored in places.at_rows(self.connection, shown).items()}
        return [
            ViewedFrame(descriptor, local, poses[row])
            for row, (descriptor, local) in zip(shown, self._descriptors_at(shown), strict=True)
        ]

    @property
    def _reach(self) -> float:
        return reach_of(self.record.same_place_radius)

    def _with_fields(
        self,
        stored: StoredPlace,
        fields: PlaceFields,
        look: ViewedFrame | None = None,
        shown: StoredPlace | None = None,
    ) -> StoredPlace:
        """A place with other fields; its position in its sequence changes only with the sequence, or if it leaves it.

        Args:
            look: the look of its new frame; None: its frame stays.
            shown: the place with its former frame; None: the frame stays.
        """
        before = stored if shown is None else shown
        moves = fields.sequence != before.place.sequence
        changed = places.with_fields(stored, fields, self._now)
        if moves or self._leaves(before, fields, look):
            new_look = look or replace(self._looks([stored.row])[0], pose=fields.pose)
            at = self._position(fields.sequence, new_look)
            code = self._code_of(fields.sequence) if moves else stored.sequence
            at = self._next_ordinal(code) if at is None else at
            changed = replace(changed, sequence=code, ordinal=at)
        self._latest.clear()
        return changed

    def _leaves(self, stored: StoredPlace, fields: PlaceFields, look: ViewedFrame | None) -> bool:
        """Whether a place whose sequence stays does not belong to its position any more, because of a change."""
        if fields.sequence is None or (look is None and fields.pose == stored.place.pose):
            return False
        code, ordinal, number = stored.sequence, stored.ordinal, stored.number
        first = sequences.first_at(self.connection, code, ordinal, before=number)
        if first is None:
            return False
        beside = [] if look is None else sequences.beside(self.connection, code, ordinal, number, stored.row)
        began, *others = self._looks([first, *beside])
        return leaves_view(fields.pose, look, began, others, self._reach)

    def _put_keypoints(self, stored: StoredPlace, found: Keypoints) -> None:
        if self.record.verification:
            self.put_keypoints(stored, found.record())

    def put_picture(self, row: int, picture: bytes) -> None:
        """Store the picture of a frame that has none."""
        self._pictures_by_row[row] = picture

    def put_keypoints(self, stored: StoredPlace, record: bytes) -> None:
        """Store the record of the keypoints of a place's frame, in the place of any other."""
        self._keypoints[stored.row] = stored.digest, record
        self.changed = True

    def add_keypoints(self, frame: PicturedPlace, found: Keypoints) -> bool:
        """Store the keypoints of a place that has none, if it still shows the frame; returns whether it does."""
        stored = self.find(frame.id)
        if stored is None or stored.digest != frame.digest or frames.has_keypoints(self.connection, stored.row):
            return False
        self._put_keypoints(stored, found)
        return self.record.verification

    def renew(self, item: SameFrame) -> tuple[Place, Change] | None:
        """Change the fields of a place that shows this frame; None if it shows another frame or is gone.

        A look that shows it stays as it is.
        """
        stored = self.find(item.id)
        if stored is None or stored.digest != item.digest:
            return None
        return self.set_fields(stored, item.fields) if stored.look_of is None else (stored.shown(), "unchanged")

    def set_fields(self, stored: StoredPlace, fields: PlaceFields) -> tuple[Place, Change]:
        """Change the fields of a place; its frame stays."""
        if same_fields(stored.place, fields):
            return stored.place, "unchanged"
        self._expect_coordinates(stored.place.id, fields.pose, stored)
        return self._put(self._with_fields(stored, fields), stored).place, "updated"

    def count_served(self, stored: StoredPlace, right: int, wrong: int, passed: int) -> None:
        """Add to how a look has served."""
        counted = replace(stored, right=stored.right + right, wrong=stored.wrong + wrong, passed=stored.passed + passed)
        self._put(counted, stored)

    def adopt(self, item: Enrolment, history: History) -> bool:
        """Store a place of another map, or a look of a place, with its history.

        Returns:
            Whether it is there: not if it is a look, and its place is gone, shows the same frame, has too many, or has
            another of this name.
        """
        with suppress(UnknownPlace, RepeatedLook, LookNameTaken, TooManyLooks):
            self.enrol(item, history.picture, history.ordinal)
        self._latest.clear()
        stored = self.find(item.id)
        if stored is None or (stored.look_of is not None and stored.digest != item.digest):
            return False
        moments = {"created_at": history.created_at, "updated_at": history.updated_at}
        if stored.look_of is not None:
            self._put(places.with_place(stored, **moments), stored)
            return True
        ordinal = stored.ordinal if history.ordinal is None else history.ordinal
        changed = replace(places.with_place(stored, **moments), ordinal=ordinal)
        self._put(changed, stored)
        sequences.keep_free(self.connection, stored.sequence, max(ordinal + 1, history.behind))
        return True

    def set_counterpart(
        self, stored: StoredPlace, track: int | None, station: int | None, pose: Pose | None, pose_of: str | None
    ) -> None:
        """Set the station of a place, None for its own, its pose and the place from which it got the pose."""
        if (track, station) == (stored.sequence, stored.ordinal):
            track = station = None
        fields: dict[str, Any] = {"pose_of": pose_of}
        if pose != stored.place.pose:
            fields |= {"pose": pose, "updated_at": self._now}
        changed = replace(places.with_place(stored, **fields), track=track, station=station)
        self._put(changed, stored)

    def drop_picture(self, stored: StoredPlace) -> None:
        """Delete the picture of a place."""
        frames.delete_pictures(self.connection, [stored.row])
        self._put(places.with_place(stored, picture="none"), stored)

    def forget(self, stored: StoredPlace) -> None:
        """Delete a place with its looks, or one look of a place."""
        for look in places.looks_of(self.connection, stored):
            self._remove(look)
        self._remove(stored)
        if stored.look_of is None:
            self._drop_if_empty(stored.sequence)
            self._latest.clear()
        elif (place := self.find(place_and_look(stored.place.id)[0])) is not None:
            self._put(places.with_place(place, looks=place.place.looks - 1), place)

    def _remove(self, stored: StoredPlace) -> None:
        places.remove(self.connection, stored)
        self._found[stored.place.id] = None
        self._count(stored, -1)
        self._leave(stored)

    def note_recall(self, recall: str | None) -> None:
        """Store the recall of the codes, as it was measured, in JSON."""
        self.state = replace(self.state, recall=recall)

    def edit(self, changed: MapRecord) -> None:
        """Replace the map's record, with the next revision."""
        made = changed.model_copy(update={"revision": self.record.revision + 1, "updated_at": self._now})
        self.state = replace(self.state, record=made)
        record.put_record(self._connection, made)

    def finish(self) -> None:
        """Store the state of the map and the descriptors; nothing is left out of the COMMIT that follows."""
        if self.changed or self.state != self._before:
            self.state = replace(self.state, revision=self._revision, stamp=secrets.token_hex(8))
        self._store_waiting()
        if self._new:
            descriptors, local = ({row: both[at] for row, both in self._new.items()} for at in (0, 1))
            rows.put(self._connection, "descriptors", descriptors)
            rows.put(self._connection, "locals", local)
            if _has_codes(self.state):
                self._put_codes(descriptors)
        if _has_codes(self.state) and not _has_codes(self._before):
            uncoded = rows.uncoded(self._connection)
            for start in range(0, len(uncoded), _CODED_AT_ONCE):
                some = uncoded[start : start + _CODED_AT_ONCE]
                self._put_codes(rows.at(self._connection, "descriptors", some))
        if self.state != self._before:
            record.put_counters(self._connection, self.state)
            rows.note_revision(self._connection, self.state.revision, self.state.stamp)

    def _put_codes(self, stored: Mapping[int, bytes]) -> None:
        codes = Coder.of(self._form.dimension).encode(self._form.descriptors(list(stored.values())))
        rows.put(self._connection, "codes", dict(zip(stored, map(bytes, codes), strict=True)))


_CODED_AT_ONCE = 256


def _has_codes(state: MapState) -> bool:
    """Whether the rows of a map have codes; those of a map that is compared whole need none."""
    return state.searched >= COMPACT_FROM or state.record.index == "compact"
