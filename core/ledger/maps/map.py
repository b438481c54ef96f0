"""A map: reading and writing its ledger, whatever keeps its vectors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from datetime import datetime
from functools import partial
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from core.errors import (
    InvalidImage,
    MixedCoordinates,
    NoThumbnail,
    RevisionMismatch,
    StorageFailure,
    TooManyLooks,
    TooManyToDelete,
    UnknownLook,
    UnknownPlace,
    UnknownSequence,
)
from core.frames.images import ANY_SIZE, decode, encode_thumbnail
from core.frames.value_ranges import few_values
from core.geometry.keypoints import Keypoints
from core.ledger.maps import frames, places, sequences
from core.ledger.maps.cameras import Cameras
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.counterparts import Counterparts
from core.ledger.maps.plan import Plan
from core.ledger.maps.transfer import Transfer
from core.ledger.maps.writing import Write
from core.maps.enrolling import Reject, check_enrolment, refuse_all
from core.maps.glances import Glances
from core.maps.pagination import Listing, decode_name, decode_number, listing_of_places, one_more, page_of
from core.maps.place_filter import EVERY_PLACE, PlaceFilter
from core.maps.records import (
    Change,
    Enrolment,
    MapRecord,
    PicturedPlace,
    SameFrame,
    SequenceSummary,
    patched_fields,
    patched_record,
)
from core.places import Look, Place, PlaceFields, look_address, place_and_look


class LedgerMap(ABC):
    """The part of a map that is in a ledger (:class:`core.maps.store.Map`).  Any thread may call any method."""

    def __init__(self) -> None:
        self.cameras = Cameras(self._reading, self._writing, lambda: self.state)
        self.counterparts = Counterparts(self._reading, self._writing)
        self.plan = Plan(self._reading)
        self._glances = Glances(self.keypoints_at)
        self.transfer = Transfer(self._reading, self._writing, self.paused_writes)

    # Of the store

    @property
    @abstractmethod
    def record(self) -> MapRecord:
        """The map's record as of its last edit."""

    @property
    @abstractmethod
    def state(self) -> object:
        """A value that is the same until the map is written to."""

    @abstractmethod
    def _reading(self) -> AbstractContextManager[MapConnection]:
        """A transaction that reads the map, and raises if the map is gone."""

    def _glancing(self) -> AbstractContextManager[MapConnection]:
        """A connection for single statements about rows, which find nothing if the map is gone."""
        return self._reading()

    @abstractmethod
    def _writing(self) -> AbstractContextManager[Write]:
        """One write, which is stored whole at the end of the block, or not at all."""

    @abstractmethod
    def paused_writes(self) -> AbstractContextManager[None]:
        """Nobody but this thread writes to the map during the block."""

    # Reading

    def place(self, place_id: str) -> Place:
        """One place.

        Raises:
            UnknownPlace.
        """
        with self._reading() as connection:
            return places.expect(connection, place_id).place

    def places(
        self, cursor: str | None, limit: int, wanted: PlaceFilter = EVERY_PLACE
    ) -> tuple[list[Place], str | None]:
        """A page of places in the order of their enrolment, and the cursor of the next page.

        Args:
            wanted: which places are listed.

        Raises:
            InvalidCursor.
        """
        most, listing = one_more(limit), listing_of_places(self.record.id, wanted)
        after = decode_number(listing, cursor)
        with self._reading() as connection:
            found = places.listed(connection, after, most, wanted)
        page, more = page_of(listing, found, limit, lambda stored: stored.number)
        return [stored.place for stored in page], more

    def ids_of(self, wanted: PlaceFilter, most: int) -> list[str]:
        """The ids of the places that fulfil some conditions, in the order of their enrolment.

        Raises:
            TooManyToDelete: there are more than ``most``.
        """
        with self._reading() as connection:
            return _not_more(places.ids_of(connection, wanted, most + 1), most)

    def sequences(self, cursor: str | None, limit: int) -> tuple[list[SequenceSummary], str | None]:
        """A page of sequences by name, and the cursor of the next page.

        Raises:
            InvalidCursor.
        """
        listing: Listing = ["sequences", self.record.id]
        after = decode_name(listing, cursor)
        with self._reading() as connection:
            found = sequences.summaries_after(connection, after, one_more(limit))
        return page_of(listing, found, limit, lambda sequence: sequence.name)

    def unknown_sequences(self, names: Sequence[str]) -> set[str]:
        """Those of the names that no sequence has."""
        with self._reading() as connection:
            return {name for name in names if sequences.find_code(connection, name) is None}

    def digest(self, place_id: str) -> bytes | None:
        """SHA-256 (32 bytes) of the image of a place; None if there is no such place."""
        with self._reading() as connection:
            stored = places.find(connection, place_id)
        return None if stored is None else stored.digest

    def places_at(self, rows: Sequence[int]) -> list[Place | None]:
        """The places of rows that a search returned; None where a place was deleted or got another frame since.

        Of the row of a look it is its place, with the camera and the picture of the look, which it names.
        """
        with self._glancing() as connection:
            found = places.at_rows(connection, [int(row) for row in rows])
        return [None if (stored := found.get(int(row))) is None else stored.shown() for row in rows]

    def rows_of(self, place_ids: Sequence[str]) -> list[int | None]:
        """The rows of places; None where there is no such place."""
        with self._reading() as connection:
            found = places.rows_of(connection, place_ids)
        return [found.get(place_id) for place_id in place_ids]

    def keypoints_at(self, rows: Sequence[int]) -> list[Keypoints | None]:
        """The keypoints of the places of rows that a search returned.

        Returns:
            In the order of ``rows``; None where a place was deleted or got another frame since, where none are stored,
            and where the stored ones are damaged, which is logged.
        """
        wanted = [int(row) for row in rows]
        with self._glancing() as connection:
            found = frames.keypoints_at(connection, wanted)
        return [found.get(row) for row in wanted]

    def glances_at(self, rows: Sequence[int]) -> NDArray[np.int8]:
        """The best keypoints of those places, int8 [n, 64, 64] (``core.geometry.matching``); zeros where are none."""
        return self._glances.at([int(row) for row in rows])

    def without_keypoints(self, after: int, limit: int) -> list[PicturedPlace]:
        """Places that keep their image or a thumbnail, and no keypoints or damaged ones.

        Args:
            after: the number of the last place of the page before; 0 for the first page.
            limit: how many places are listed at most; fewer if there are no further ones.
        """
        with self._reading() as connection:
            return frames.without_keypoints(connection, after, limit)

    def picture(self, place_id: str) -> bytes | None:
        """The stored picture of a place's frame, as the place's ``picture`` says; None if it is gone or has none.

        Raises:
            StorageFailure: the picture is missing or damaged.
        """
        return self._pictured(place_id)[1]

    def thumbnail(self, place_id: str) -> bytes:
        """A small JPEG of a place.

        Raises:
            UnknownPlace: there is no such place.
            NoThumbnail: the map keeps no picture of it, or one that cannot be shown.
            StorageFailure: the picture is missing or damaged.
            MemoryError: its pixels do not fit into memory.
        """
        place, picture = self._pictured(place_id)
        if place is None:
            raise UnknownPlace(f"The map has no place {place_id[:140]!r}.")
        if picture is None:
            raise NoThumbnail(f"The map keeps no picture of {_named(place_id)}.")
        if place.picture == "thumbnail":
            return picture
        try:
            return encode_thumbnail(decode(picture, ANY_SIZE, few_values(picture)))
        except InvalidImage as error:
            raise NoThumbnail(f"The stored picture of {_named(place_id)} cannot be shown: {error}") from error

    def _pictured(self, place_id: str) -> tuple[Place | None, bytes | None]:
        """A place and its picture; None for what there is not."""
        with self._reading() as connection:
            stored = places.find(connection, place_id)
            if stored is None:
                return None, None
            try:
                picture = frames.pictures_at(connection, [stored.row]).get(stored.row)
            except StorageFailure as damage:
                raise StorageFailure(f"The stored picture of {_named(place_id)} is damaged.") from damage
            if picture is None and stored.place.picture != "none":
                raise StorageFailure(f"The stored picture of {_named(place_id)} is missing.")
            return stored.place, picture

    # Writing

    def edit(self, changes: Mapping[str, Any], expected_revision: int | None = None) -> MapRecord:
        """Change settings (the fields of MapSettings) or ``calibration`` (None: use that of the encoder).

        ``keep`` applies to frames enrolled later; pictures that are stored already stay.  The revision grows by one if
        anything changes.

        Raises:
            InvalidField: a field is unknown or fixed, or its value is not allowed.
            RevisionMismatch: the record is not at ``expected_revision``.
        """
        with self._writing() as write:
            before = write.record
            if expected_revision is not None and expected_revision != before.revision:
                raise RevisionMismatch(f"The map is at revision {before.revision}, not {expected_revision}.")
            changed = patched_record(before, changes)
            if changed != before:
                write.edit(changed)
        return write.record

    @overload
    def enrol(self, items: Sequence[Enrolment]) -> Sequence[tuple[Place, Change]]: ...

    @overload
    def enrol(
        self, items: Sequence[Enrolment | SameFrame], reject: Reject = ...
    ) -> Sequence[tuple[Place, Change] | None]: ...

    def enrol(
        self, items: Sequence[Enrolment | SameFrame], reject: Reject = refuse_all
    ) -> Sequence[tuple[Place, Change] | None]:
        """Store frames as places, all of them or, if this raises, none, with one COMMIT.

        See :meth:`core.maps.store.Map.enrol`.
        """
        new = [item for item in items if isinstance(item, Enrolment)]
        for item in new:
            check_enrolment(item, self.record.dimension, self.record.local_shape)
        if not items:
            return []
        with self._writing() as write:
            write.look_for([item.id for item in items])
            return [_enrolled(write, item, partial(reject, position)) for position, item in enumerate(items)]

    def set_fields(self, place_id: str, fields: PlaceFields) -> tuple[Place, Change]:
        """Replace all fields of a place; its frame stays.

        Raises:
            UnknownPlace, InvalidField, MixedCoordinates.
        """
        with self._writing() as write:
            return write.set_fields(places.expect(write.connection, place_id), fields)

    def patch(self, place_id: str, changes: Mapping[str, Any]) -> Place:
        """Apply a merge patch (RFC 7396) to pose, timestamp, sequence and metadata.

        Raises:
            UnknownPlace, InvalidField, MixedCoordinates.
        """
        with self._writing() as write:
            stored = places.expect(write.connection, place_id)
            return write.set_fields(stored, patched_fields(stored.place, changes))[0]

    def add_keypoints(self, found: Sequence[tuple[PicturedPlace, Keypoints]]) -> int:
        """Store the keypoints of places that :meth:`without_keypoints` listed, with one COMMIT.

        A place that is gone, shows another frame by now, or has got its keypoints meanwhile stays as it is; so do all
        places of a map whose setting ``verification`` is off.

        Returns:
            How many were stored.
        """
        if not found:
            return 0
        with self._writing() as write:
            return sum(write.add_keypoints(frame, of_frame) for frame, of_frame in found)

    def forget(self, place_id: str) -> None:
        """Delete a place with its looks.

        Raises:
            UnknownPlace.
        """
        with self._writing() as write:
            write.forget(places.expect(write.connection, place_id))

    def looks(self, place_id: str) -> list[Look]:
        """The looks of a place besides its first, in the order in which they were added.

        Raises:
            UnknownPlace.
        """
        with self._reading() as connection:
            return [one.look() for one in places.looks_of(connection, places.expect(connection, place_id))]

    def all_looks(
        self, cursor: str | None, limit: int, run: str | None = None
    ) -> tuple[list[tuple[str, Look]], str | None]:
        """A page of the looks of all places, each with the id of its place, in the order in which they were added.

        Args:
            run: only those that were learnt from it.

        Raises:
            InvalidCursor.
        """
        listing: Listing = ["looks", self.record.id, run]
        after = decode_number(listing, cursor)
        with self._reading() as connection:
            found = places.looks_after(connection, after, one_more(limit), run)
        page, more = page_of(listing, found, limit, lambda stored: stored.number)
        return [(place_and_look(stored.place.id)[0], stored.look()) for stored in page], more

    def forget_look(self, place_id: str, look: str) -> None:
        """Delete a look of a place.

        Raises:
            UnknownPlace, UnknownLook.
        """
        with self._writing() as write:
            places.expect(write.connection, place_id)
            if (stored := places.find(write.connection, look_address(place_id, look))) is None:
                raise UnknownLook(f"Place {place_id!r} has no look {look[:80]!r}.")
            write.forget(stored)

    def forget_looks(self, addresses: Sequence[str]) -> int:
        """Delete looks by address, those that there are, all in one commit; returns how many there were."""
        with self._writing() as write:
            found = places.of_ids(write.connection, addresses)
            looks = [stored for stored in found.values() if stored.look_of is not None]
            for stored in looks:
                write.forget(stored)
        return len(looks)

    def learnt_looks(self) -> dict[int, Look]:
        """The looks that were learnt from runs, by row."""
        with self._reading() as connection:
            return {
                one.row: one.look() for one in places.looks_after(connection, -1, 1 << 62, None) if one.run is not None
            }

    def count_learnt(self) -> int:
        """How many places were learnt from runs, or have looks that were."""
        with self._reading() as connection:
            return places.count_learnt(connection)

    def count_served(self, counts: Mapping[int, tuple[int, int, int]]) -> None:
        """Add to how looks have served, by row: frames won rightly, won wrongly, and passed; in one commit.

        Rows that are no look's any more are left out.
        """
        if not counts:
            return
        with self._writing() as write:
            for row, stored in places.at_rows(write.connection, list(counts)).items():
                if stored.look_of is not None:
                    write.count_served(stored, *counts[row])

    def withdraw(self, rows: Sequence[int]) -> int:
        """Delete learnt looks by row, in one commit; returns how many were there."""
        if not rows:
            return 0
        with self._writing() as write:
            return _withdrawn(write, rows)

    def learn(self, look: Enrolment, instead: Sequence[int], most_places: int | None = None) -> tuple[Change, int]:
        """Add a learnt look to a place, and delete learnt looks by row to make room for it, in one commit.

        Returns:
            What changed, and how many looks were deleted; none if the place has the look.

        Raises:
            UnknownPlace, RepeatedLook, LookNameTaken, NoRegions, ValueError: as of :meth:`enrol`.
            TooManyLooks: the place, or the map, may not have it.
        """
        check_enrolment(look, self.record.dimension, self.record.local_shape)
        with self._writing() as write:
            if (stored := write.find(look.id)) is not None and stored.digest == look.digest:
                return "unchanged", 0
            gone = _withdrawn(write, instead)
            change = write.enrol(look)[1]
            if most_places is not None and places.count_learnt(write.connection) > most_places:
                raise TooManyLooks(f"The map learns {most_places} places and looks of places at most.")
        return change, gone

    def forget_learnt(self, run: str | None, since: datetime | None = None, until: datetime | None = None) -> int:
        """Delete the looks that were learnt from a run or in a period, all in one commit; returns how many there were.

        Args:
            run: None: any.
            since, until: when they were added, the end apart; None: there is no bound.
        """
        with self._writing() as write:
            found = places.learnt_from(write.connection, run, since, until)
            for stored in found:
                write.forget(stored)
        return len(found)

    def forget_new_ground(self, run: str) -> int:
        """Delete the places that were learnt from a run, all in one commit; returns how many there were."""
        with self._writing() as write:
            found = places.places_learnt_from(write.connection, run)
            for stored in found:
                write.forget(stored)
        return len(found)

    def forget_all(self, wanted: PlaceFilter, most: int) -> list[str]:
        """Delete the places that fulfil some conditions, all in one commit; returns their ids.

        Raises:
            TooManyToDelete: there are more than ``most``; none is deleted.
        """
        with self._writing() as write:
            found = _not_more(places.ids_of(write.connection, wanted, most + 1), most)
            for place_id in found:
                write.forget(places.expect(write.connection, place_id))
        return found

    def drop_pictures(self, before: datetime, most: int) -> int:
        """Delete the pictures of up to ``most`` places that were enrolled before a moment; returns how many there were.

        The places stay, and so do their keypoints.
        """
        with self._reading() as connection:
            if not places.pictured_before(connection, before, 1):
                return 0
        with self._writing() as write:
            found = places.pictured_before(write.connection, before, most)
            for place_id in found:
                write.drop_picture(places.expect(write.connection, place_id))
        return len(found)

    def forget_sequence(self, name: str) -> int:
        """Delete all places of a sequence; returns how many.

        Raises:
            UnknownSequence: there is none.
        """
        count, spelled = 0, None
        with self._writing() as write:
            while some := places.listed(write.connection, -1, _AT_ONCE, PlaceFilter(sequence=name)):
                if count and some[0].place.sequence != spelled:
                    break  # another traverse, of old, whose name looks the same
                spelled = some[0].place.sequence
                for stored in some:
                    write.forget(stored)
                count += len(some)
            if not count:
                raise UnknownSequence(f"The map has no sequence {name[:128]!r}.")
        return count


_AT_ONCE = 1000


def _enrolled(
    write: Write, item: Enrolment | SameFrame, reject: Callable[[Exception], None]
) -> tuple[Place, Change] | None:
    try:
        return write.enrol(item) if isinstance(item, Enrolment) else write.renew(item)
    except MixedCoordinates as error:  # before anything of the item was changed
        reject(error)
        return None


def _withdrawn(write: Write, rows: Sequence[int]) -> int:
    """Delete learnt looks by row; returns how many were there."""
    going = [one for one in places.at_rows(write.connection, list(rows)).values() if one.run is not None]
    for stored in going:
        write.forget(stored)
    return len(going)


def _named(address: str) -> str:
    """A place or a look, as messages name it."""
    place_id, look = place_and_look(address)
    return f"place {place_id!r}" if look is None else f"look {look!r} of place {place_id!r}"


def _not_more(ids: list[str], most: int) -> list[str]:
    """The ids; raises TooManyToDelete if they are more than ``most``."""
    if len(ids) > most:
        raise TooManyToDelete(f"More than {most} places fulfil the conditions. Delete them in several requests.")
    return ids
