"""One map: its places on disk, and the snapshot in memory that is searched."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from core.disk.files import Damage, disk_errors
from core.errors import MapQuarantined, PlacerecError, StorageFailure, UnknownMap
from core.ledger.maps import frames, places
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.map import LedgerMap
from core.ledger.maps.record import MapState
from core.maps.records import MapRecord, VerifyReport
from core.maps.selection import Selection
from core.maps.status import ErasureReport, IndexStatus, KeypointsStatus, Progress, StorageStatus, no_progress
from core.maps.store import Reject, refuse_all
from core.places import Place
from core.storage.archives.exporter import Exporter
from core.storage.database.connections import FILE, DatabaseClosed, at_one_moment, connect, read_now
from core.storage.database.schema import connection_of
from core.storage.database.segments import SegmentEntry, segment_entries
from core.storage.erasing import DeadRows, dead_rows, erase_rows, wait_until
from core.storage.opening import OpenMap, named_damage, open_map
from core.storage.review import FILE as REVIEW_FILE
from core.storage.review import ReviewFrames
from core.storage.search.indexing import IndexedMap, Indexer, Stopped
from core.storage.search.scopes import Chooser
from core.storage.search.snapshot import SearchScope, Snapshot
from core.storage.search.tiers import storage_of, unopened
from core.storage.verification import inspect
from core.storage.writing import FailedWrites, FileWrite

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


class Map(LedgerMap):
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
        self._state: MapState | None = None
        self._snapshot: Snapshot | None = None
        self._damage: str | None = None
        self._end: PlacerecError | None = None
        self._failed_writes = FailedWrites(folder)
        self._recent_places = RecentPlaces()
        self._keypoints_of: tuple[object, KeypointsStatus | None] = (None, None)  # in a state of the database
        self._dead_rows: DeadRows | None = None  # of the last erasure
        self.indexer: Indexer | None = None
        super().__init__()
        self.review = ReviewFrames(folder / REVIEW_FILE, record.id, self._expect_open)
        self.exporter = Exporter(folder, self._reading, lambda: self._opened, self._guarded, self.review)

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
                    self._opened, self._state, self._record = opened, opened.state, opened.state.record
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
            with named_damage(), disk_errors(f"{action} map {self._folder.name!r}"):
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

    def erase(self, progress: Progress = no_progress) -> ErasureReport:
        """Overwrite what deleted places have left (:meth:`core.maps.store.Map.erase`); writes wait for parts of it."""
        with self._lock, self._guarded("erase deleted places of"):
            opened, newest = self._expect_open(), self.snapshot()
            self._failed_writes.repair(opened, newest.rows)
            dead, self._snapshot = dead_rows(newest, self._dead_rows)
            self._dead_rows = dead
            del newest
            removed = opened.removed_segments
        total, done, count = len(dead), 0, 0
        wait_until(lambda: not dead.are_read and not removed.in_use, lambda: progress(0, total))
        for number, offsets in dead.offsets.items():
            with self._lock, self._guarded("erase deleted places of"):
                count += erase_rows(self._folder, opened.layout, self.snapshot(), number, offsets)
            done += len(offsets)
            progress(done, total)
        wait_until(self._removed_are_gone, lambda: progress(done, total))
        if self.indexer is not None:
            with disk_errors(f"erase deleted places of map {self._record.id!r}"), suppress(Stopped):
                self.indexer.forget_codes(list(dead.offsets), lambda: progress(done, total))
        with self._lock, self._guarded("erase deleted places of"):
            freed = self._expect_open().database.erase()
        freed += self.review.erase()
        return ErasureReport(rows=count, bytes=freed + count * opened.layout.record.itemsize)

    def _removed_are_gone(self) -> bool:
        """Delete the files of removed segments that nobody reads any more; whether that are all of them."""
        with self._lock:
            removed = self._expect_open().removed_segments
            removed.clear(self.snapshot())
            return not removed.waiting

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
                count, size, _ = frames.room(connection)
            known = self._keypoints_of = (state, KeypointsStatus(places=count, bytes=size))
        return known[1]

    @contextmanager
    def _reading(self) -> Iterator[MapConnection]:
        with self._guarded("read"):
            try:
                with self._expect_open().database.reading() as connection, at_one_moment(connection):
                    yield connection
                return
            except DatabaseClosed:
                pass
        self._expect_open()  # raises the reason
        raise StorageFailure(f"Map {self._folder.name!r} was closed.")

    # Writing

    @contextmanager
    def _writing(self) -> Iterator[FileWrite]:
        with self._lock:
            opened, before, state = self._expect_open(), self.snapshot(), self._state
            assert state is not None
            with self._guarded("write to"):
                opened.removed_segments.clear(before)  # the write may need this room
                self._failed_writes.repair(opened, before.rows)
                write = None
                try:
                    with opened.database.transaction() as connection:
                        write = FileWrite(self._folder, opened, state, before, connection)
                        yield write
                        write.finish()
                except BaseException as error:
                    if write is not None:
                        self._failed_writes.note(error, write, opened, before.rows)
                    raise
            after = self._snapshot = write.after
            self._state, self._record = write.state, write.record
            del before
            opened.removed_segments.clear(after)
            if self.indexer is not None and ((write.filled and after.coded) or self.indexer.needs_work(after)):
                self.indexer.wake()

    @contextmanager
    def paused_writes(self) -> Iterator[None]:
        with self._lock:
            yield

    def drop_pictures(self, before: datetime, most: int) -> int:
        if not self.is_open:  # a map without such pictures is not opened for this
            with self._lock, self._guarded("read"):
                connection = connect(self._folder / FILE)
                try:
                    if not places.pictured_before(connection_of(connection), before, 1):
                        return 0
                finally:
                    connection.close()
        return super().drop_pictures(before, most)

    def enrol(self, items: Any, reject: Reject = refuse_all) -> Any:
        found = super().enrol(items, reject)
        if items and self.indexer is not None:
            self.indexer.keep_up()
        return found

    # Reading

    def snapshot(self) -> Snapshot:
        """All places at this moment, for searching; later writes do not change the snapshot."""
        while (snapshot := self._snapshot) is None:
            self._expect_open()
        return snapshot

    def scope(self, selection: Selection | None = None) -> SearchScope:
        snapshot = self.snapshot()
        return Chooser(snapshot, self._reading).scope(selection) if selection else SearchScope(snapshot)

    def count_places(self) -> int:
        """How many places the map has; this does not read it from disk."""
        state = self._state
        return self._places if state is None else state.places

    def places_at(self, rows: Sequence[int]) -> list[Place | None]:
        state, wanted = self._expect_open().database.state, [int(row) for row in rows]
        found = self._recent_places.places(state, wanted)
        if missing := [row for row in wanted if row not in found]:
            with self._reading() as connection:
                read = {row: stored.shown() for row, stored in places.at_rows(connection, missing).items()}
            self._recent_places.keep(state, read)
            found.update(read)
        return [found.get(row) for row in wanted]

    def verify(self, progress: Progress = no_progress) -> VerifyReport:
        """Read all files of the map again and check them; writes and searches go on meanwhile.

        The report is about the moment of the call.  A damaged map is reported but not quarantined, because what is
        searched is in memory and passed its checks when it was read.
        """
        with ExitStack() as stack:
            with self._lock:
                snapshot = self.snapshot()
                connection = stack.enter_context(self._reading())
                read_now(connection)
            return inspect(self._folder, connection, snapshot, self.review, progress)
