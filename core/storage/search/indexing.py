"""Building the codes of a map in the background, until the map has the tier that it should have.

Each map has one thread for this, while there is work.  It reads rows and makes codes of them without holding up writes
or searches, and publishes the codes in a new snapshot, a few hundred rows at a time; rows without a code are compared
exactly.  Codes are written to files (:mod:`core.storage.search.index_files`), so that after a kill the work continues
after the last complete file.  Then the blocks of codes are joined, so that a search need not read all of them.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from core.disk.files import Damage
from core.errors import MapQuarantined, UnknownMap
from core.index import Codes, CodeTable
from core.index.flat import flat_index, vectors
from core.maps.records import TierSetting
from core.maps.status import IndexStatus, Recall, Tier
from core.storage.database.segments import SegmentEntry
from core.storage.files.array_files import StaleArrays
from core.storage.search.index_files import IndexFiles
from core.storage.search.rebuilding import codes_of, extended, rebuilt
from core.storage.search.recall import measure_recall
from core.storage.search.segment import HeldRows
from core.storage.search.snapshot import Snapshot, threads
from core.storage.search.tiers import holds_for, tier_for

log = logging.getLogger(__name__)

_ROWS_AT_ONCE = 256
MOST_BEHIND = 4096
"""Rows that may wait for their codes; a writer that is faster makes codes itself."""
_NICENESS = 10
_PATIENCE_SECONDS = 0.1
_GROWN = 2  # when the places have grown by this factor, the recall is measured again


class Stopped(Exception):
    """The map was closed; raised in the thread that builds."""


@dataclass(frozen=True)
class IndexedMap:
    """The interface of a map for its indexer.

    setting: returns the tier that the owner chose.
    snapshot: returns the newest snapshot.
    publish: replaces the newest snapshot by a change of it, while no write can happen; raises Stopped if the map was
        closed.
    entries: returns the segments as SQLite has them.
    quarantine: takes the map out of service, because it is damaged.
    """

    setting: Callable[[], TierSetting]
    snapshot: Callable[[], Snapshot]
    publish: Callable[[Callable[[Snapshot], Snapshot]], Snapshot]
    entries: Callable[[], Sequence[SegmentEntry]]
    quarantine: Callable[[Damage], None]


def tier_of(snapshot: Snapshot) -> Tier:
    """How a snapshot is searched."""
    return "exact" if snapshot.table is None else "compact"


class Indexer:
    """Builds the codes of one map.  Any thread may use it."""

    def __init__(self, of: IndexedMap, files: IndexFiles) -> None:
        """For an open map."""
        self._map = of
        self._files = files
        self._lock = threading.Lock()
        self._building = threading.Lock()  # held by the thread that builds
        self._thread: threading.Thread | None = None
        self.problem: str | None = None
        """Why the last attempt to build failed, if it did."""
        self._again = False
        self._stopping = threading.Event()
        self._progress = 0.0
        self._recall: Recall | None = None
        self._written: set[tuple[SegmentEntry, ...]] = set()

    def wake(self) -> None:
        """Start building in the background, if there is anything to build."""
        with self._lock:
            if self._stopping.is_set():
                return
            self._again = True
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="index", daemon=True)
                self._thread.start()

    def stop(self, wait: bool = True) -> None:
        """Stop building; published indexes stay.

        Args:
            wait: wait until the thread has ended; not while the map's lock is held.
        """
        with self._lock:
            self._stopping.set()
            thread = self._thread if wait else None
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def status(self, newest: Callable[[], Snapshot | None]) -> IndexStatus | None:
        """How the map is searched; None if it has no snapshot any more.

        Args:
            newest: returns the newest snapshot.  It is called after the state of the building was read; otherwise the
                index could be reported as ready but missing.
        """
        with self._lock:
            is_building, progress, recall = self._thread is not None, self._progress, self._recall
        if (snapshot := newest()) is None:
            return None
        present = tier_of(snapshot)
        return IndexStatus(
            setting=self._map.setting(),
            tier=present,
            wanted=self._wanted(snapshot),
            state="building" if is_building else "ready",
            progress=min(1.0, progress) if is_building else 1.0,
            rows_indexed=snapshot.coded,
            recall=None if present == "exact" else recall,
            bytes_in_memory=snapshot.memory,
            problem=self.problem,
        )

    def _wanted(self, snapshot: Snapshot) -> Tier:
        return tier_for(self._map.setting(), len(snapshot), tier_of(snapshot))

    def _holds(self, snapshot: Snapshot) -> bool:
        """Whether a map should hold its descriptors in memory."""
        return holds_for(self._map.setting(), len(snapshot), snapshot.holds)

    def _is_held_as_wanted(self, snapshot: Snapshot) -> bool:
        holds = self._holds(snapshot)
        there = (segment.held is not None for segment in snapshot.segments if not segment.removed)
        return snapshot.holds == holds and all(held == holds for held in there)

    def needs_work(self, snapshot: Snapshot) -> bool:
        """Whether anything has to be built for a snapshot; this is cheap."""
        if tier_of(snapshot) != self._wanted(snapshot) or not self._is_held_as_wanted(snapshot):
            return True
        if snapshot.table is None:
            return False
        if snapshot.coded < snapshot.rows or snapshot.table.is_loose:
            return True
        return self._recall is None or self._recall.places * _GROWN < len(snapshot)

    def _work(self) -> None:
        threads()  # started before this thread lowers its priority, which they would inherit
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        while True:
            with self._lock:
                if not self._again or self._stopping.is_set():
                    self._thread = None
                    return
                self._again, self._progress = False, 0.0
            try:
                with self._building:
                    self._build()
                self.problem = None
                if self.needs_work(self._map.snapshot()):  # a write changed what is wanted meanwhile
                    with self._lock:
                        self._again = True
            except (Stopped, UnknownMap, MapQuarantined):
                pass
            except Damage as damage:
                self._map.quarantine(damage)
            except Exception:
                # It is tried again with the next write or start; searches use what is there.
                log.exception("The index of a map could not be completed.")
                self.problem = "the index of the map could not be completed; the log says why"

    def _build(self) -> None:
        snapshot = self._map.snapshot()
        if self._holds(snapshot) and not self._is_held_as_wanted(snapshot):
            self._hold_all()
        if self._wanted(snapshot) == "exact":
            if snapshot.table is not None:
                self._drop_codes()
            return
        self._code_all()
        self._keep_codes()
        self._join()
        self._measure()

    def _publish(self, change: Callable[[Snapshot], Snapshot]) -> Snapshot:
        if self._stopping.is_set():
            raise Stopped
        return self._map.publish(change)

    def _report(self, done: int, total: int) -> None:
        if self._stopping.is_set():
            raise Stopped
        self._progress = done / max(1, total)

    def rebuild(self, progress: Callable[[int, int], None]) -> None:
        """Build codes again from the descriptors; the present ones are searched until they are replaced.

        Args:
            progress: called with the number of rows done and of all; if it raises, nothing changes.

        Raises:
            Stopped: the map was closed.
            Damage, OSError, MapQuarantined: a descriptor cannot be read.
        """

        def report(done: int, total: int) -> None:
            progress(done, total)
            if self._stopping.is_set():
                raise Stopped

        while not self._building.acquire(timeout=_PATIENCE_SECONDS):
            report(0, self._map.snapshot().rows)
        try:
            if self._wanted(self._map.snapshot()) == "exact":
                return
            table = rebuilt(self._map.snapshot, report)

            def put(newest: Snapshot) -> Snapshot:
                if newest.table is None:
                    return newest  # its owner has chosen exact search meanwhile
                return replace(newest, table=extended(table, newest, newest.rows))

            self._publish(put)
            self._written.clear()
            self._recall = None
            self._keep_codes()
        finally:
            self._building.release()
            self.wake()

    # Codes

    def _code_all(self) -> None:
        """Make codes of all rows and, in a map that should not hold them, free the descriptors in memory."""
        newest = self._map.snapshot()
        holds = self._holds(newest)
        if newest.table is None or newest.holds != holds:
            table = CodeTable.empty(self._files.coder)
            newest = self._publish(
                lambda now: replace(now, table=table if now.table is None else now.table, holds=holds)
            )
        while newest.coded < newest.rows:
            newest = self._let_go(self._code_group(newest.coded))
            self._report(newest.coded, newest.rows)
        if not newest.holds:
            self._free(newest, len(newest.segments))

    def _code_group(self, start: int) -> Snapshot:
        """Add the codes of the next rows: those of a whole group from its file if that is good, else computed ones."""
        entries = self._map.entries()
        newest = self._map.snapshot()
        per_segment = newest.rows_per_segment
        group = start // per_segment // self._files.group_size
        of_group = self._files.group_entries(entries, group)
        if start == group * self._files.group_size * per_segment:
            with suppress(StaleArrays):
                codes = self._files.read_codes(of_group)
                newest = self._publish(lambda now: now.with_codes(codes) if now.coded == start else now)
                self._written.add(tuple(of_group))
                return newest
        newest, stop = self._code_rows(newest, start)
        if stop == sum(segment.rows for segment in entries[: (group + 1) * self._files.group_size]):
            self._keep_group(of_group)
        return newest

    def _code_rows(self, newest: Snapshot, start: int) -> tuple[Snapshot, int]:
        """Add the codes of the next rows of a segment; the newest snapshot, and the row after them."""
        per_segment = newest.rows_per_segment
        number = start // per_segment
        stop = min(start + _ROWS_AT_ONCE, newest.rows, (number + 1) * per_segment)
        codes = codes_of(self._files.coder, newest, start, stop)
        newest = self._publish(
            # Another thread may have made them first, or its owner may have chosen exact search.
            lambda now: now.with_codes(codes) if now.table is not None and now.coded == start else now
        )
        if stop == (number + 1) * per_segment and newest.segments[number].held is not None and not newest.holds:
            newest = self._publish(lambda now: now.holding(number, None))
        return newest, stop

    def _let_go(self, newest: Snapshot) -> Snapshot:
        """Free what has codes if the map has grown too large to hold its descriptors since its codes were begun."""
        if newest.holds and not self._holds(newest):
            newest = self._publish(lambda now: replace(now, holds=False))
            newest = self._free(newest, newest.coded // newest.rows_per_segment)
        return newest

    def _free(self, newest: Snapshot, count: int) -> Snapshot:
        """Free the descriptors in memory of the first ``count`` segments."""
        for number in range(count):
            if newest.segments[number].held is not None:
                newest = self._publish(lambda now, number=number: now.holding(number, None))  # type: ignore[misc]
        return newest

    def keep_up(self) -> None:
        """Make codes in the calling thread until at most ``MOST_BEHIND`` rows wait for theirs.

        The building thread leaves the cores to others.  A writer that leaves it none would fill the memory with
        descriptors, and searches would compare ever more rows one by one.
        """
        with suppress(Stopped, UnknownMap, MapQuarantined, Damage, OSError):  # the building thread meets the same
            if (newest := self._map.snapshot()).table is None:
                return
            newest = self._let_go(newest)
            while newest.rows - newest.coded > MOST_BEHIND:
                newest, _ = self._code_rows(newest, newest.coded)

    def _keep_group(self, of_group: Sequence[SegmentEntry]) -> None:
        snapshot = self._map.snapshot()
        first = of_group[0].number * snapshot.rows_per_segment
        if tuple(of_group) in self._written or snapshot.table is None:
            return
        rows = sum(segment.rows for segment in of_group)
        codes = self._living_codes(snapshot, first, first + rows)
        if len(codes) < rows:  # a write has committed rows that no snapshot has yet
            return
        if self._files.write_codes(of_group, codes):
            self._written.add(tuple(of_group))

    def _keep_codes(self) -> None:
        """Write the codes of every complete group to its file, including codes that writes have added."""
        entries = self._map.entries()
        for group in range(len(entries) // self._files.group_size):
            of_group = self._files.group_entries(entries, group)
            if of_group[-1].rows == of_group[0].rows:
                self._report(group, len(entries))
                self._keep_group(of_group)

    def keep_tail(self, snapshot: Snapshot, entries: Sequence[SegmentEntry]) -> None:
        """Write the codes of the last, incomplete group, so that the next start need not compute them."""
        of_group = self._files.group_entries(entries, max(0, len(entries) - 1) // self._files.group_size)
        if of_group and snapshot.table is not None and snapshot.coded == snapshot.rows:
            first = of_group[0].number * snapshot.rows_per_segment
            if tuple(of_group) not in self._written:
                self._files.write_codes(of_group, self._living_codes(snapshot, first, snapshot.rows))

    def _living_codes(self, snapshot: Snapshot, start: int, stop: int) -> Codes:
        """The codes of rows for a file, those of rows without a place blank; fewer if fewer rows have one."""
        assert snapshot.table is not None
        codes = snapshot.table.codes(start, stop)
        dead = ~snapshot.alive[start : start + len(codes)]
        codes[dead] = self._files.coder.blank(int(dead.sum()))
        return codes

    def forget_codes(self, numbers: Sequence[int], look: Callable[[], None]) -> None:
        """Delete the files of the codes of some segments, and write them again without those of deleted places.

        Args:
            look: is called while codes are being built; its exceptions end the waiting.

        Raises:
            Stopped: the map was closed.
            OSError: the disk refuses.
        """
        while not self._building.acquire(timeout=_PATIENCE_SECONDS):
            look()
            if self._stopping.is_set():
                raise Stopped
        try:
            for group in {number // self._files.group_size for number in numbers}:
                self._files.remove_codes(group)
                self._written = {of for of in self._written if of[0].number // self._files.group_size != group}
        finally:
            self._building.release()
        self.wake()

    def _join(self) -> None:
        """Join blocks of codes until few rows are left in blocks of which every code is read."""
        while (table := self._map.snapshot().table) is not None and (block := table.joined(self._report)) is not None:
            self._publish(lambda now, block=block: now.with_block(block))  # type: ignore[misc]

    # Recall

    def _measure(self) -> None:
        snapshot = self._map.snapshot()
        if snapshot.table is None:
            return
        if self._recall is None:
            with suppress(StaleArrays):
                self._recall = self._files.read_recall()
        if self._recall is not None and self._recall.places * _GROWN >= len(snapshot):
            return
        found = measure_recall(snapshot, self._report)
        if found is not None:
            self._recall = found
            self._files.write_recall(found)

    # Back to exact search

    def _hold_all(self) -> None:
        """Read all descriptors into memory."""
        newest = self._publish(lambda now: replace(now, holds=True))
        for number, segment in enumerate(newest.segments):
            if segment.held is None and not segment.removed:
                self._hold(number)
            self._report(number + 1, len(newest.segments))

    def _drop_codes(self) -> None:
        self._publish(lambda now: replace(now, table=None))
        with self._lock:
            self._recall = None
            self._written.clear()
        self._files.remove()

    def _hold(self, number: int) -> None:
        """Read the descriptors of a segment into memory; the last segment may grow meanwhile."""

        def read(now: Snapshot, before: HeldRows | None) -> HeldRows:
            first, count = now.segments[number].first_row, len(now.segments[number])
            done = 0 if before is None else before.index.ntotal
            rows = np.arange(first + done, first + count)
            index = flat_index(count, now.dimension, now.halves)
            local = np.zeros((count, *now.local_shape), np.int8)
            if before is not None:
                vectors(index)[:done], local[:done] = vectors(before.index), before.local
            vectors(index)[done:], local[done:] = now.descriptors_at(rows), now.locals_at(rows)
            return HeldRows(index, local)

        newest = self._map.snapshot()
        if newest.segments[number].removed:
            return
        first = read(newest, None)
        self._publish(lambda now: now if now.segments[number].removed else now.holding(number, read(now, first)))
