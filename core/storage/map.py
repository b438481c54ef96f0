"""One map: its places on disk, and the snapshot in memory that is searched."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

from core.disk.files import Damage, disk_errors
from core.errors import (
    InvalidImage,
    MapQuarantined,
    NoThumbnail,
    PlacerecError,
    RevisionMismatch,
    StorageFailure,
    TooManyToDelete,
    UnknownMap,
    UnknownSequence,
)
from core.frames.images import ANY_SIZE, decode, encode_thumbnail
from core.geometry.keypoints import Keypoints
from core.maps.enrolling import check_enrolment
from core.maps.place_filter import EVERY_PLACE, PlaceFilter
from core.maps.records import (
    Change,
    Enrolment,
    MapRecord,
    PicturedPlace,
    SameFrame,
    SequenceSummary,
    VerifyReport,
    patched_fields,
    patched_record,
)
from core.maps.selection import Selection
from core.maps.status import IndexStatus, KeypointsStatus, Progress, StorageStatus, no_progress
from core.places import Place, PlaceFields
from core.storage.archives.exporter import Exporter
from core.storage.attributes import Attributes
from core.storage.cameras import Cameras
from core.storage.counterparts import Counterparts
from core.storage.database import keypoints, ledger
from core.storage.database.connections import DatabaseClosed
from core.storage.database.ledger import SegmentEntry, segment_entries
from core.storage.listings import page_of_places, page_of_sequences
from core.storage.opening import OpenMap, open_map
from core.storage.plan import Plan
from core.storage.review import FILE as REVIEW_FILE
from core.storage.review import ReviewFrames
from core.storage.search.indexing import IndexedMap, Indexer, Stopped
from core.storage.search.scopes import Chooser
from core.storage.search.snapshot import SearchScope, Snapshot
from core.storage.search.tiers import storage_of, unopened
from core.storage.transfer import Transfer
from core.storage.verification import inspect
from core.storage.writing import FailedWrites, Write

log = logging.getLogger(__name__)


MOST_RECENT = 1024
"""Places of a map that are remembered after they were read …"""

LONGEST_METADATA = 1000
"""… unless their metadata has more characters, so that all together take five megabytes at most."""


class RecentPlaces:
    """Places of a map that were read since its last write, by row; a query of the same place need not read them again.

    They are forgotten with every write, so that no place is ever returned as it was before.  Any thread may use this.
    """

    def __init__(self) -> None:
        self._cached: tuple[object, dict[int, Place]] = (object(), {})

    def places(self, state: object, rows: Iterable[int]) -> dict[int, Place]:
        """The places of ``rows`` that were read in this state of the map (``Database.state``)."""
        of, places = self._cached
        if of is not state:
            return {}
        found = ((row, places.get(row)) for row in rows)
        return {row: place for row, place in found if place is not None}

    def keep(self, state: object, places: Mapping[int, Place]) -> None:
        """Remember places that were read after the map was found in this state."""
        small = {row: place for row, place in places.items() if len(str(place.metadata)) <= LONGEST_METADATA}
        of, cached = self._cached
        if of is not state or len(cached) + len(small) > MOST_RECENT:
            self._cached = (state, dict(list(small.items())[:MOST_RECENT]))
        else:
            cached.update(small)


class Map:
    """The places of one environment (:class:`core.maps.store.Map`).  Any thread may call any method.

    One thread writes at a time.  A write returns when it is synced, and every later snapshot contains it; reads and
    searches never wait for a write.

    Any method may raise MapQuarantined (the map is found to be damaged), StorageFailure (the disk refuses) and
    UnknownMap (the map was deleted meanwhile); methods that write may also raise StorageFull.  A write that raises has
    changed nothing.
    """

    def __init__(self, folder: Path, record: MapRecord, places: int = 0) -> None:
        """The map in ``folder``; all but its record and its number of places is read on first use."""
        self._folder = folder
        self._record = record
        self._places = places
        self._lock = threading.RLock()  # held while the map is written, opened or closed
        self._opened: OpenMap | None = None
        self._snapshot: Snapshot | None = None
        self._damage: str | None = None
        self._end: PlacerecError | None = None
        self._failed_writes = FailedWrites(folder)
        self._recent_places = RecentPlaces()
        self._keypoints_of: tuple[object, KeypointsStatus | None] = (None, None)  # in a state of the database
        self.indexer: Indexer | None = None
        self.cameras = Cameras(self._reading, self._writing)
        self.attributes = Attributes(self._reading)
        self.counterparts = Counterparts(self._reading, self._writing)
        self.plan = Plan(self._reading)
        self.transfer = Transfer(self._reading, self._writing, self._lock)
        self.review = ReviewFrames(folder / REVIEW_FILE, self._expect_open)
        self.exporter = Exporter(folder, self._reading, lambda: self._opened, self._guarded)

    # Opening and closing

    @property
    def record(self) -> MapRecord:
        return self._record

    @property
    def damage(self) -> str | None:
        """Why the map is quarantined; None while it is in service."""
        return self._damage

    def check_serving(self) -> None:
        """Raise MapQuarantined if the map is known to be damaged."""
        if self._damage is not None:
            raise self._quarantined()

    @property
    def is_open(self) -> bool:
        """Whether the map is in service and was read from disk."""
        return self._opened is not None

    @property
    def held(self) -> bool:
        """Whether all descriptors are in memory, so that a search does not read from the disk."""
        return (snapshot := self._snapshot) is not None and snapshot.holds

    @property
    def state(self) -> object:
        """An object that stays the same until the map is written to; the map is opened if it is not open yet."""
        return self._expect_open().database.state

    def open(self) -> None:
        """Read the map from disk, unless that was done before."""
        self._expect_open()

    def close(self, deleted: bool = False) -> None:
        """Wait for the reads and the write under way, and refuse further ones."""
        with self._lock:  # from here on the map is not opened again
            name = self._folder.name
            if self._end is None:
                self._end = (
                    UnknownMap(f"There is no map {name!r}.") if deleted else StorageFailure(f"Map {name!r} is closed.")
                )
        if (indexer := self.indexer) is not None:
            indexer.stop()
        self.review.close()
        with self._lock:
            opened, last, self._opened, self._snapshot = self._opened, self._snapshot, None, None
            if opened is None:
                return
            if indexer is not None and last is not None and not deleted:
                with suppress(Damage, OSError, sqlite3.Error), opened.database.reading() as connection:
                    indexer.keep_tail(last, segment_entries(connection, opened.layout))
            opened.database.close()

    def _expect_open(self) -> OpenMap:
        if (opened := self._opened) is not None:
            return opened
        with self._lock:
            if self._end is not None:
                raise type(self._end)(*self._end.args)
            if self._damage is not None:
                raise self._quarantined()
            if self._opened is None:
                with self._guarded("open"):
                    opened, snapshot = open_map(self._folder)
                    self._opened, self._record = opened, opened.record
                    self._snapshot = replace(snapshot, guard=self._searching)
                    self.indexer = Indexer(self._indexed(opened), opened.files)
                    if self.indexer.needs_work(self._snapshot):
                        self.indexer.wake()
            return self._opened

    def _quarantined(self) -> MapQuarantined:
        return MapQuarantined(f"Map {self._folder.name!r} is damaged and out of service: {self._damage}.")

    @contextmanager
    def _guarded(self, action: str) -> Iterator[None]:
        """Turn errors of the disk into ours; quarantine the map if it is damaged."""
        try:
            with disk_errors(f"{action} map {self._folder.name!r}"):
                yield
        except (Damage, StorageFailure) as damage:
            if self._end is not None:
                raise type(self._end)(*self._end.args) from damage  # a closed or deleted map's files may be gone
            if isinstance(damage, StorageFailure):
                raise
            self._quarantine(damage)
            raise self._quarantined() from damage

    def _quarantine(self, damage: Damage) -> None:
        log.error("Map %s is quarantined: %s", self._folder.name, damage)
        self._damage = str(damage)
        with self._lock:
            opened, self._opened, self._snapshot = self._opened, None, None
            if opened is not None:
                opened.database.close()
        if self.indexer is not None:
            self.indexer.stop(wait=False)

    @contextmanager
    def _searching(self) -> Iterator[None]:
        with self._guarded("search"):
            yield

    def _indexed(self, opened: OpenMap) -> IndexedMap:
        """The part of the map that the indexer uses."""

        def publish(change: Callable[[Snapshot], Snapshot]) -> Snapshot:
            with self._lock:
                if self._snapshot is None:
                    raise Stopped
                self._snapshot = change(self._snapshot)
                return self._snapshot

        def entries() -> Sequence[SegmentEntry]:
            with self._reading() as connection:
                return segment_entries(connection, opened.layout)

        return IndexedMap(lambda: self._record.index, self.snapshot, publish, entries, self._quarantine)

    def index_status(self) -> IndexStatus:
        """How the map is searched; this does not read it from disk."""
        indexer = self.indexer
        found = None if indexer is None else indexer.status(lambda: self._snapshot)
        return unopened(self._record.index, self._places) if found is None else found

    def rebuild_index(self, progress: Progress = no_progress) -> IndexStatus:
        """Build the codes of a map again from its descriptors; searches use the present ones meanwhile.

        A map that is searched exactly has none, so nothing is done.

        Args:
            progress: called with the number of rows that are done and of all; if it raises, nothing changes.

        Raises:
            UnknownMap, MapQuarantined, StorageFailure.
        """
        self.open()
        if (indexer := self.indexer) is not None:
            with disk_errors(f"read map {self._record.id!r}"), suppress(Stopped):
                indexer.rebuild(progress)
        self.open()  # raises if the map was closed meanwhile
        return self.index_status()

    def storage_status(self) -> StorageStatus:
        with self._guarded("read"):
            return storage_of(self._folder, self._record.precision, self.count_places(), self._keypoints_status())

    def _keypoints_status(self) -> KeypointsStatus | None:
        """How many places have keypoints; None while the map is not read from disk."""
        opened = self._opened
        if opened is None:
            return None
        state, known = opened.database.state, self._keypoints_of
        if known[0] is not state:
            with self._reading() as connection:
                places, size = keypoints.room(connection)
            known = self._keypoints_of = (state, KeypointsStatus(places=places, bytes=size))
        return known[1]

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        with self._guarded("read"):
            try:
                with self._expect_open().database.reading() as connection:
                    yield connection
                return
            except DatabaseClosed:
                pass
        self._expect_open()  # raises the reason
        raise StorageFailure(f"Map {self._folder.name!r} was closed.")

    # Writing

    @contextmanager
    def _writing(self) -> Iterator[Write]:
        with self._lock:
            opened, before = self._expect_open(), self.snapshot()
            with self._guarded("write to"):
                opened.removed_segments.clear(before)  # the write may need this room
                self._failed_writes.repair(opened, before.rows)
                write = None
                try:
                    with opened.database.transaction() as connection:
                        write = Write(self._folder, opened, self._record, before, connection)
                        yield write
                        after = write.finish()
                except BaseException as error:
                    if write is not None:
                        self._failed_writes.note(error, write, opened, before.rows)
                    raise
            self._snapshot, self._record = after, write.record
            del before
            opened.removed_segments.clear(after)
            if self.indexer is not None and ((write.filled and after.coded) or self.indexer.needs_work(after)):
                self.indexer.wake()

    def edit(self, changes: Mapping[str, Any], expected_revision: int | None = None) -> MapRecord:
        """Change settings (the fields of MapSettings) or ``calibration`` (None: use that of the encoder).

        ``keep`` applies to frames enrolled later; pictures that are stored already stay.  The revision grows by one if
        anything changes.

        Raises:
            InvalidField: a field is unknown or fixed, or its value is not allowed.
            RevisionMismatch: the record is not at ``expected_revision``.
        """
        with self._writing() as write:
            if expected_revision is not None and expected_revision != write.record.revision:
                raise RevisionMismatch(f"The map is at revision {write.record.revision}, not {expected_revision}.")
            record = patched_record(write.record, changes)
            if record != write.record:
                write.edit(record)
        return write.record

    @overload
    def enrol(self, items: Sequence[Enrolment]) -> Sequence[tuple[Place, Change]]: ...

    @overload
    def enrol(self, items: Sequence[Enrolment | SameFrame]) -> Sequence[tuple[Place, Change] | None]: ...

    def enrol(self, items: Sequence[Enrolment | SameFrame]) -> Sequence[tuple[Place, Change] | None]:
        """Store frames as places, all of them or, if this raises, none, with one sync and one COMMIT.

        The items are stored in the order given, which is the order of the places in their sequences.  An id that
        exists keeps its place and creation time: if the frame's digest is the same, only its fields are stored
        (``unchanged``, ``updated``), otherwise its frame is ``replaced``.  An id may occur twice.

        Returns:
            The place of each item and what changed.  None for a SameFrame whose place is gone or shows another frame:
            such an item changes nothing.

        Raises:
            InvalidIdentifier, InvalidField: an id or metadata that cannot be stored.
            NoRegions: a descriptor is all zero.
            ValueError: descriptors or a digest of the wrong kind.
        """
        new = [item for item in items if isinstance(item, Enrolment)]
        for item in new:
            check_enrolment(item, self._record.dimension, self._record.local_shape)
        if not items:
            return []
        with self._writing() as write:
            write.expect(len(new))
            found = [write.enrol(item) if isinstance(item, Enrolment) else write.renew(item) for item in items]
        if self.indexer is not None:
            self.indexer.keep_up()
        return found

    def set_fields(self, place_id: str, fields: PlaceFields) -> tuple[Place, Change]:
        with self._writing() as write:
            return write.set_fields(ledger.expect(write.connection, place_id), fields)

    def patch(self, place_id: str, changes: Mapping[str, Any]) -> Place:
        with self._writing() as write:
            stored = ledger.expect(write.connection, place_id)
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
        with self._writing() as write:
            write.forget(ledger.expect(write.connection, place_id))

    def forget_all(self, wanted: PlaceFilter, most: int) -> list[str]:
        """Delete the places that fulfil some conditions, all in one commit; returns their ids.

        Raises:
            TooManyToDelete: there are more than ``most``; none is deleted.
        """
        with self._writing() as write:
            found = _not_more(ledger.ids_of(write.connection, wanted, most + 1), most)
            for place_id in found:
                write.forget(ledger.expect(write.connection, place_id))
        return found

    def forget_sequence(self, name: str) -> int:
        with self._writing() as write:
            count = write.forget_sequence(name)
            if not count:
                raise UnknownSequence(f"The map has no sequence {name[:128]!r}.")
        return count

    # Reading

    def snapshot(self) -> Snapshot:
        """All places at this moment, for searching; later writes do not change the snapshot."""
        while (snapshot := self._snapshot) is None:
            self._expect_open()
        return snapshot

    def scope(self, selection: Selection | None = None) -> SearchScope:
        snapshot = self.snapshot()
        return Chooser(snapshot, self.attributes, self.rows_of).scope(selection) if selection else SearchScope(snapshot)

    def count_places(self) -> int:
        """How many places the map has; this does not read it from disk."""
        snapshot = self._snapshot
        return self._places if snapshot is None else len(snapshot)

    def digest(self, place_id: str) -> bytes | None:
        with self._reading() as connection:
            stored = ledger.find(connection, place_id)
        return None if stored is None else stored.digest

    def place(self, place_id: str) -> Place:
        with self._reading() as connection:
            return ledger.expect(connection, place_id).place

    def places(
        self, cursor: str | None, limit: int, wanted: PlaceFilter = EVERY_PLACE
    ) -> tuple[list[Place], str | None]:
        """A page of places in the order of their enrolment, and the cursor of the next page.

        Args:
            wanted: which places are listed.

        Raises:
            InvalidCursor.
        """
        with self._reading() as connection:
            return page_of_places(connection, self._folder.name, cursor, limit, wanted)

    def ids_of(self, wanted: PlaceFilter, most: int) -> list[str]:
        with self._reading() as connection:
            return _not_more(ledger.ids_of(connection, wanted, most + 1), most)

    def sequences(self, cursor: str | None, limit: int) -> tuple[list[SequenceSummary], str | None]:
        with self._reading() as connection:
            return page_of_sequences(connection, self._folder.name, cursor, limit)

    def places_at(self, rows: Sequence[int]) -> list[Place | None]:
        state, wanted = self._expect_open().database.state, [int(row) for row in rows]
        found = self._recent_places.places(state, wanted)
        if missing := [row for row in wanted if row not in found]:
            with self._reading() as connection:
                read = ledger.places_of_rows(connection, missing)
            self._recent_places.keep(state, read)
            found.update(read)
        return [found.get(row) for row in wanted]

    def unknown_sequences(self, names: Sequence[str]) -> set[str]:
        return set(names) - set(self.attributes.sequence_codes(names))

    def rows_of(self, place_ids: Sequence[str]) -> list[int | None]:
        """The descriptor rows of places, for :meth:`Snapshot.descriptors_at`; None where there is no such place."""
        with self._reading() as connection:
            found = ledger.rows_of_places(connection, list(place_ids))
        return [found.get(place_id) for place_id in place_ids]

    def keypoints_at(self, rows: Sequence[int]) -> list[Keypoints | None]:
        """The keypoints of the places of rows that a search returned, read from disk.

        Returns:
            In the order of ``rows``; None where a place was deleted or got another frame since, where none are stored,
            and where the stored ones are damaged, which is logged.
        """
        wanted = [int(row) for row in rows]
        with self._reading() as connection:
            found = keypoints.at_rows(connection, wanted)
        return [found.get(row) for row in wanted]

    def without_keypoints(self, after: int, limit: int) -> list[PicturedPlace]:
        with self._reading() as connection:
            return keypoints.frames_without(connection, after, limit)

    def picture(self, place_id: str) -> bytes | None:
        with self._reading() as connection:
            stored = ledger.find(connection, place_id)
            return None if stored is None else ledger.picture(connection, stored.number, place_id)

    def thumbnail(self, place_id: str) -> bytes:
        with self._reading() as connection:
            stored = ledger.expect(connection, place_id)
            picture = ledger.picture(connection, stored.number, place_id)
        if picture is None:
            raise NoThumbnail(f"The map keeps no picture of place {place_id!r}.")
        if stored.place.picture == "thumbnail":
            return picture
        try:
            return encode_thumbnail(decode(picture, ANY_SIZE))
        except InvalidImage as error:
            raise NoThumbnail(f"The stored picture of place {place_id!r} cannot be shown: {error}") from error

    def verify(self, progress: Progress = no_progress) -> VerifyReport:
        """Read all files of the map again and check them; writes and searches go on meanwhile.

        The report is about the moment of the call.  A damaged map is reported but not quarantined, because what is
        searched is in memory and passed its checks when it was read.
        """
        with ExitStack() as stack:
            with self._lock:
                snapshot = self.snapshot()
                connection = stack.enter_context(self._reading())
                connection.execute("BEGIN")
                connection.execute("SELECT id FROM map").fetchall()  # a transaction sees the moment of its first read
            return inspect(self._folder, connection, snapshot, progress)


def _not_more(ids: list[str], most: int) -> list[str]:
    """The ids; raises TooManyToDelete if they are more than ``most``."""
    if len(ids) > most:
        raise TooManyToDelete(f"More than {most} places fulfil the conditions. Delete them in several requests.")
    return ids
