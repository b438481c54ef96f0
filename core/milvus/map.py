"""One map in PostgreSQL and Milvus."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, overload

from psycopg import Connection

from core.errors import (
    InvalidImage,
    InvalidKeypoints,
    NoThumbnail,
    RevisionMismatch,
    StorageFailure,
    TooManyToDelete,
    UnknownPlace,
    UnknownSequence,
)
from core.frames.images import ANY_SIZE, decode, encode_thumbnail
from core.geometry.keypoints import Keypoints, keypoints_of
from core.ledger.postgres import postgres_errors
from core.maps.enrolling import check_enrolment
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
from core.maps.selection import Selection
from core.maps.status import IndexStatus, KeypointsStatus, Progress, StorageStatus, Tier, no_progress
from core.milvus import ledger
from core.milvus.collection import Collection
from core.milvus.database import Database
from core.milvus.ledger import MapState, PlaceEntry
from core.milvus.parts.cameras import MilvusCameras
from core.milvus.parts.counterparts import MilvusCounterparts
from core.milvus.parts.exporter import MilvusExporter
from core.milvus.parts.plan import MilvusPlan
from core.milvus.parts.review import MilvusReview
from core.milvus.parts.transfer import MilvusTransfer
from core.milvus.pictures.stored import read_pictures
from core.milvus.snapshot import MilvusScope, MilvusSnapshot, scope_of
from core.milvus.writing import Write, expect_place
from core.places import Place, PlaceFields

if TYPE_CHECKING:
    from core.milvus.pictures.objects import Objects

log = logging.getLogger(__name__)

REBUILT_AT_ONCE = 256
"""Places whose entities are made again in one transaction."""


class MilvusMap:
    """The places of one environment (:class:`core.maps.store.Map`).  Any thread of any process may call any method.

    One transaction writes to a map at a time.  Any method may raise StorageFailure (PostgreSQL or Milvus refuses, or
    cannot be reached) and UnknownMap; methods that write may also raise StorageFull.
    """

    def __init__(
        self, database: Database, collection: Collection, state: MapState, objects: Objects | None = None
    ) -> None:
        """The map that was found in this state.

        Args:
            objects: where new pictures are put; None: in PostgreSQL.
        """
        self.objects = objects
        self._database, self.collection, self._state = database, collection, state
        self._last: MilvusSnapshot | None = None
        self._room: tuple[int, StorageStatus] | None = None
        self._paused = threading.local()
        self.cameras = MilvusCameras(state.number, self._reading, self._locked)
        self.transfer = MilvusTransfer(state.number, self._reading, self.writing, self.paused_writes)
        self.counterparts = MilvusCounterparts(state.number, self._reading, self.writing)
        self.review = MilvusReview(state.number, self._reading, database, objects)
        self.plan = MilvusPlan(state.number, self._reading)
        self.exporter = MilvusExporter(self.viewing, lambda: self.state, database, objects)

    @property
    def record(self) -> MapRecord:
        """The map's record as it was when this object last read or wrote the map."""
        return self._state.record

    @property
    def is_open(self) -> bool:
        """True: nothing has to be read before the map can be used."""
        return True

    @property
    def held(self) -> bool:
        """False: everything comes from other processes."""
        return False

    @property
    def state(self) -> object:
        with self.viewing() as (_, state):
            return state.number, state.writes

    def open(self) -> None:
        """Raise if the map is gone."""
        with self._reading():
            pass

    @property
    def number(self) -> int:
        """Of the map; never used for another one, also of the same id."""
        return self._state.number

    def note(self, state: MapState) -> None:
        """Remember a state that was read, unless a later one is known."""
        if state.writes >= self._state.writes:
            self._state = state

    @contextmanager
    def viewing(self) -> Iterator[tuple[Connection[Any], MapState]]:
        """A transaction that reads the map, and the map's state in it."""
        with self._database.reading() as connection:
            state = ledger.state_of(connection, self.record.id, self.number)
            self.note(state)
            yield connection, state

    @contextmanager
    def _reading(self) -> Iterator[Connection[Any]]:
        with self.viewing() as (connection, _):
            yield connection

    # Searching

    def snapshot(self) -> MilvusSnapshot:
        """All places at this moment; the same object until the map is written to."""
        with self.viewing() as (connection, state):
            self._last = self._snapshot(connection, state)
            return self._last

    def _snapshot(self, connection: Connection[Any], state: MapState) -> MilvusSnapshot:
        last = self._last
        if last is not None and last.state == state:
            return last
        orphans = tuple(ledger.orphans(connection, self.number))
        return MilvusSnapshot(self._database, self.collection, state, orphans)

    def scope(self, selection: Selection | None = None) -> MilvusScope:
        with self.viewing() as (connection, state):
            return scope_of(connection, self._snapshot(connection, state), selection)

    def places_at(self, rows: Sequence[int]) -> list[Place | None]:
        with self._reading() as connection:
            entries = ledger.entries_by(connection, self.number, "row", [int(row) for row in rows])
        found = {entry.row: entry.place for entry in entries}
        return [found.get(int(row)) for row in rows]

    def keypoints_at(self, rows: Sequence[int]) -> list[Keypoints | None]:
        """The keypoints of those places; None also without any, and where they are damaged, which is logged."""
        with self._reading() as connection:
            entries = ledger.entries_by(connection, self.number, "row", [int(row) for row in rows])
            records = ledger.of_frames(connection, self.number, "keypoints", [entry.row for entry in entries])
        return [None if (record := records.get(int(row))) is None else _keypoints(int(row), record) for row in rows]

    def rows_of(self, place_ids: Sequence[str]) -> list[int | None]:
        with self._reading() as connection:
            entries = ledger.entries_by(connection, self.number, "id", place_ids)
        found = {entry.place.id: entry.row for entry in entries}
        return [found.get(place_id) for place_id in place_ids]

    # Reading

    def count_places(self) -> int:
        with self.viewing() as (_, state):
            return state.places

    def place(self, place_id: str) -> Place:
        with self._reading() as connection:
            return expect_place(connection, self.number, place_id).place

    def places(
        self, cursor: str | None, limit: int, wanted: PlaceFilter = EVERY_PLACE
    ) -> tuple[list[Place], str | None]:
        most = one_more(limit)
        listing = listing_of_places(self.record.id, wanted)
        after = decode_number(listing, cursor)
        with self._reading() as connection:
            found = ledger.entries_after(connection, self.number, after, most, wanted)
        page, more = page_of(listing, found, limit, lambda entry: entry.number)
        return [entry.place for entry in page], more

    def ids_of(self, wanted: PlaceFilter, most: int) -> list[str]:
        with self._reading() as connection:
            found = ledger.entries_after(connection, self.number, -1, most + 1, wanted)
        return [entry.place.id for entry in _not_more(found, most)]

    def digest(self, place_id: str) -> bytes | None:
        with self._reading() as connection:
            entry = ledger.find(connection, self.number, place_id)
        return None if entry is None else entry.digest

    def sequences(self, cursor: str | None, limit: int) -> tuple[list[SequenceSummary], str | None]:
        listing: Listing = ["sequences", self.record.id]
        after = decode_name(listing, cursor).partition("\0")[0]  # which no name has
        with self._reading() as connection:
            found = ledger.sequences_after(connection, self.number, after, one_more(limit))
        return page_of(listing, found, limit, lambda sequence: sequence.name)

    def unknown_sequences(self, names: Sequence[str]) -> set[str]:
        with self._reading() as connection:
            return set(names) - set(ledger.sequence_codes(connection, self.number, names))

    def without_keypoints(self, after: int, limit: int) -> list[PicturedPlace]:
        """Places that keep their image or a thumbnail, and no keypoints, behind the number ``after``."""
        with self._reading() as connection:
            return ledger.without_keypoints(connection, self.number, after, limit)

    def thumbnail(self, place_id: str) -> bytes:
        entry, picture = self._picture_of(place_id)
        if entry is None:
            raise UnknownPlace(f"The map has no place {place_id[:140]!r}.")
        if picture is None:
            raise NoThumbnail(f"The map keeps no picture of place {place_id!r}.")
        if entry.place.picture == "thumbnail":
            return picture
        try:
            return encode_thumbnail(decode(picture, ANY_SIZE))
        except InvalidImage as error:
            raise NoThumbnail(f"The stored picture of place {place_id!r} cannot be shown: {error}") from error

    # How it is stored

    def index_status(self) -> IndexStatus:
        """How the map is searched: by Milvus, which compares every place if its collection has no other index."""
        tier: Tier = "exact" if self.collection.index_type == "FLAT" else "compact"
        return IndexStatus(
            setting=self.record.index,
            tier=tier,
            wanted=tier,
            state="ready",
            progress=1,
            rows_indexed=0,
            recall=None,
            bytes_in_memory=0,
        )

    def rebuild_index(self, progress: Progress = no_progress) -> IndexStatus:
        """Give Milvus all descriptors again, some at a time; searches use those that it has meanwhile.

        Args:
            progress: called with the number of places done and of all; its exceptions end the work, and the part done
                until then stays.
        """
        done, after, total = 0, -1, self.count_places()
        while True:
            with self.writing(rebuilding=True) as write:
                entries = write.all_of(EVERY_PLACE, REBUILT_AT_ONCE, after)
                for entry in entries:
                    write.renew_entity(entry)
                if not entries:
                    write.move()
            if not entries:
                return self.index_status()
            done, after = done + len(entries), entries[-1].number
            progress(min(done, total), total)

    def storage_status(self) -> StorageStatus:
        """How much room the map takes in PostgreSQL; Milvus takes some four bytes for each value besides."""
        with self.viewing() as (connection, state):
            if self._room is None or self._room[0] != state.writes:
                descriptors, pictures, keypoints, places = ledger.room(connection, self.number)
                whole = descriptors + pictures + keypoints
                status = StorageStatus(
                    precision=state.record.precision,
                    bytes_per_place=round(whole / state.places) if state.places else 0,
                    descriptors=descriptors,
                    index=0,
                    database=pictures + keypoints,
                    keypoints=KeypointsStatus(places=places, bytes=keypoints),
                )
                self._room = state.writes, status
            return self._room[1]

    def picture(self, place_id: str) -> bytes | None:
        return self._picture_of(place_id)[1]

    def _picture_of(self, place_id: str) -> tuple[PlaceEntry | None, bytes | None]:
        """A place and its picture; None for what there is not."""
        before: int | None = None
        while True:
            with self._reading() as connection:
                entry = ledger.find(connection, self.number, place_id)
                if entry is None:
                    return None, None
                pictures = ledger.pictures_of(connection, self.number, [entry.row])
            found = read_pictures(self.objects, pictures)
            if entry.row in found or entry.row not in pictures:
                return entry, found.get(entry.row)
            if entry.row == before:
                raise StorageFailure(f"The picture of place {place_id!r} is missing in the object store, or damaged.")
            before = entry.row  # or the place got another frame meanwhile

    # Writing

    @contextmanager
    def paused_writes(self) -> Iterator[None]:
        """Nobody but this thread writes to the map during the block; if that cannot be any more, this thread neither.

        Raises:
            StoreUnavailable, StorageFailure.
        """
        if getattr(self._paused, "connection", None) is not None:
            yield
            return
        with self._database.locked("pause the writes to a map", ledger.WRITING, self.number) as connection:
            self._paused.connection = connection
            try:
                yield
            finally:
                self._paused.connection = None

    @contextmanager
    def _locked(self) -> Iterator[Connection[Any]]:
        with self._transaction() as connection:
            self.note(ledger.state_of(connection, self.record.id, self.number, locked=True))
            yield connection

    @contextmanager
    def _transaction(self) -> Iterator[Connection[Any]]:
        """A transaction in which this thread may write to the map."""
        paused: Connection[Any] | None = getattr(self._paused, "connection", None)
        if paused is not None:
            with postgres_errors("write to a map"), paused.transaction():
                paused.execute("SET LOCAL synchronous_commit TO on")
                yield paused
            return
        with self._database.transaction("write to a map") as connection:
            ledger.expect_unpaused(connection, self.number)
            yield connection

    @contextmanager
    def writing(self, rebuilding: bool = False) -> Iterator[Write]:
        """Collect the changes of one write, which are stored whole at the end of the block, or not at all."""
        with self._transaction() as connection:
            state = ledger.state_of(connection, self.record.id, self.number, locked=True)
            write = Write(connection, self.collection, state, self.objects, rebuilding)
            yield write
            write.finish()
        self.note(write.state)
        self._tidy()

    def _tidy(self) -> None:
        """Delete old orphans; those that cannot be deleted now are deleted after another write."""
        try:
            with self._database.transaction("delete orphans") as connection:
                if keys := ledger.old_orphans(connection, self.number):
                    self.collection.delete(keys)
                    ledger.clear(connection, self.number, keys)
        except StorageFailure as error:
            log.warning("Map %s: %s", self.record.id, error)

    def edit(self, changes: Mapping[str, Any], expected_revision: int | None = None) -> MapRecord:
        with self.writing() as write:
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
        with self.writing() as write:
            return [write.enrol(item) if isinstance(item, Enrolment) else write.renew(item) for item in items]

    def set_fields(self, place_id: str, fields: PlaceFields) -> tuple[Place, Change]:
        with self.writing() as write:
            return write.set_fields(write.expect(place_id), fields)

    def patch(self, place_id: str, changes: Mapping[str, Any]) -> Place:
        with self.writing() as write:
            entry = write.expect(place_id)
            return write.set_fields(entry, patched_fields(entry.place, changes))[0]

    def add_keypoints(self, found: Sequence[tuple[PicturedPlace, Keypoints]]) -> int:
        """Store the keypoints of places that have none (:meth:`core.maps.store.Map.add_keypoints`)."""
        if not found:
            return 0
        with self.writing() as write:
            return sum(write.add_keypoints(frame, of_frame) for frame, of_frame in found)

    def forget(self, place_id: str) -> None:
        with self.writing() as write:
            write.forget(write.expect(place_id))

    def forget_all(self, wanted: PlaceFilter, most: int) -> list[str]:
        with self.writing() as write:
            found = _not_more(write.all_of(wanted, most + 1), most)
            for entry in found:
                write.forget(entry)
        return [entry.place.id for entry in found]

    def forget_sequence(self, name: str) -> int:
        with self.writing() as write:
            found = write.all_of(PlaceFilter(sequence=name), None)
            if not found:
                raise UnknownSequence(f"The map has no sequence {name[:128]!r}.")
            for entry in found:
                write.forget(entry)
        return len(found)


def _not_more(entries: list[PlaceEntry], most: int) -> list[PlaceEntry]:
    """The places; raises TooManyToDelete if they are more than ``most``."""
    if len(entries) > most:
        raise TooManyToDelete(f"More than {most} places fulfil the conditions. Delete them in several requests.")
    return entries


def _keypoints(row: int, record: bytes) -> Keypoints | None:
    try:
        return keypoints_of(record)
    except InvalidKeypoints as error:
        log.error("The keypoints of row %d are damaged: %s", row, error)
        return None
