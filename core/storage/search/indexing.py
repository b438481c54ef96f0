"""Building the codes and lists of a map in the background, until the map has the tier that it should have.

Each map has one thread for this, while there is work.  It reads rows and makes codes of them without holding up writes
or searches, and publishes the codes in a new snapshot, a few hundred rows at a time; rows without a code are compared
exactly.  Codes are written to files (:mod:`core.storage.search.index_files`), so that after a kill the work continues
after the last complete file.
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
from core.index import Coder, CodeTable, InvertedLists
from core.storage.database.ledger import SegmentEntry
from core.storage.files.arrays import StaleArrays
from core.storage.search.index_files import IndexFiles
from core.storage.search.rebuilding import codes_of, fitted_coder, rebuilt
from core.storage.search.recall import measure_recall
from core.storage.search.segment import Held, flat_index, vectors
from core.storage.search.snapshot import Snapshot, threads
from core.storage.search.tiers import IndexStatus, Recall, Tier, TierSetting, tier_for

log = logging.getLogger(__name__)

_ROWS_AT_ONCE = 256
_NICENESS = 10
_PATIENCE_SECONDS = 0.1
_UNLISTED_SHARE = 0.02  # lists are extended when a larger share of the rows is in none
_GROWN = 2  # when the places have grown by this factor, the recall is measured again


class Stopped(Exception):
    """The map was closed; raised in the thread that builds."""


@dataclass(frozen=True)
class IndexedMap:
    """What the indexer uses of its map.

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
    if snapshot.table is None:
        return "exact"
    return "compact" if snapshot.lists is None else "inverted"


class Indexer:
    """Builds the codes and lists of one map.  Any thread may use it."""

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
        self._recall: tuple[Tier, Recall] | None = None
        self._written: set[tuple[SegmentEntry, ...]] = set()
        self._centred = 0  # rows when the centres of the lists were computed

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
        """Stop building; what was published stays.

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
            recall=recall[1] if recall is not None and recall[0] == present else None,
            bytes_in_memory=snapshot.memory,
            problem=self.problem,
        )

    def _wanted(self, snapshot: Snapshot) -> Tier:
        return tier_for(self._map.setting(), len(snapshot), tier_of(snapshot))

    def needs_work(self, snapshot: Snapshot) -> bool:
        """Whether anything has to be built for a snapshot; this is cheap."""
        wanted = self._wanted(snapshot)
        if wanted == "exact":
            return snapshot.table is not None or not snapshot.holds
        if snapshot.coded < snapshot.rows or snapshot.holds or tier_of(snapshot) != wanted:
            return True
        if snapshot.lists is not None and snapshot.rows - snapshot.lists.rows > _UNLISTED_SHARE * snapshot.rows:
            return True
        recall = self._recall
        return recall is None or recall[0] != wanted or recall[1].places * _GROWN < len(snapshot)

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
                    wanted = self._wanted(self._map.snapshot())
                    self._build()
                self.problem = None
                if self._wanted(self._map.snapshot()) != wanted:  # a write changed it meanwhile
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
        if self._wanted(snapshot) == "exact":
            if snapshot.table is not None or not snapshot.holds:
                self._hold_all()
            return
        self._code_all()
        self._keep_codes()
        if self._wanted(self._map.snapshot()) == "inverted":
            self._list_all()
        elif self._map.snapshot().lists is not None:
            self._publish(lambda newest: replace(newest, lists=None))
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
        """Build codes and lists again from the descriptors; the present ones are searched until they are replaced.

        Args:
            progress: is called with the rows done and all rows; what it raises leaves everything as it was.

        Raises:
            Stopped: the map was closed.
            Damage, OSError, MapQuarantined: a descriptor cannot be read.
        """

        def told(done: int, total: int) -> None:
            progress(done, total)
            if self._stopping.is_set():
                raise Stopped

        while not self._building.acquire(timeout=_PATIENCE_SECONDS):
            told(0, self._map.snapshot().rows)
        try:
            if (wanted := self._wanted(self._map.snapshot())) == "exact":
                return
            made = rebuilt(self._map.snapshot, wanted == "inverted", told)
            self._publish(made.put_into)
            self._files.write_coder(made.table.coder)
            self._written.clear()
            self._recall = None
            self._keep_codes()
            if made.lists is not None:
                self._centred = made.lists.rows
                self._files.write_lists(made.table.coder, made.lists, self._centred, self._map.entries())
        finally:
            self._building.release()
            self.wake()

    # Codes

    def _code_all(self) -> None:
        """Make codes of all rows and free the descriptors in memory."""
        newest = self._map.snapshot()
        if newest.table is None:
            coder = self._coder(newest)
            newest = self._publish(lambda now: replace(now, table=CodeTable.empty(coder), holds=False))
        elif newest.holds:
            newest = self._publish(lambda now: replace(now, holds=False))
        while newest.coded < newest.rows:
            assert newest.table is not None
            newest = self._code_group(newest.table.coder, newest.coded)
            self._report(newest.coded, newest.rows)
        for number, segment in enumerate(newest.segments):
            if segment.held is not None:
                self._publish(lambda now, number=number: now.holding(number, None))  # type: ignore[misc]

    def _coder(self, snapshot: Snapshot) -> Coder:
        try:
            return self._files.read_coder()
        except StaleArrays as stale:
            log.info("The codes of a map are built: coder.index: %s.", stale)
        coder = fitted_coder(snapshot)
        self._files.write_coder(coder)
        return coder

    def _code_group(self, coder: Coder, start: int) -> Snapshot:
        """Add the codes of the next rows: those of a whole group from its file if that is good, else computed ones."""
        entries = self._map.entries()
        newest = self._map.snapshot()
        per_segment = newest.rows_per_segment
        group = start // per_segment // self._files.group_size
        of_group = self._files.group_entries(entries, group)
        if start == group * self._files.group_size * per_segment:
            with suppress(StaleArrays):
                codes = self._files.read_codes(coder, of_group)
                newest = self._publish(lambda now: now.with_codes(codes) if now.coded == start else now)
                self._written.add(tuple(of_group))
                return newest
        stop = min(start + _ROWS_AT_ONCE, newest.rows, (start // per_segment + 1) * per_segment)
        number = start // per_segment
        codes = codes_of(coder, newest, start, stop)
        newest = self._publish(lambda now: now.with_codes(codes) if now.coded == start else now)
        if stop == (number + 1) * per_segment and newest.segments[number].held is not None:
            newest = self._publish(lambda now: now.holding(number, None))
        if stop == sum(segment.rows for segment in entries[: (group + 1) * self._files.group_size]):
            self._keep_group(of_group)
        return newest

    def _keep_group(self, of_group: Sequence[SegmentEntry]) -> None:
        snapshot = self._map.snapshot()
        first = of_group[0].number * snapshot.rows_per_segment
        if tuple(of_group) in self._written or snapshot.table is None:
            return
        codes = snapshot.table.codes(first, first + sum(segment.rows for segment in of_group))
        if self._files.write_codes(snapshot.table.coder, of_group, codes):
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
                self._files.write_codes(snapshot.table.coder, of_group, snapshot.table.codes(first, snapshot.rows))

    # Lists

    def _list_all(self) -> None:
        """Make lists of nearly all rows; the codes of the few others are all read by a search."""
        snapshot = self._map.snapshot()
        assert snapshot.table is not None
        lists = snapshot.lists
        if lists is None or not self._centred:  # the file says how many rows there were when the centres were computed
            with suppress(StaleArrays):
                entries = self._map.entries()
                lists, self._centred = self._files.read_lists(snapshot.table.coder, snapshot.coded, entries)
        # Centres are computed again when the rows have doubled.
        if lists is None or 2 * self._centred < snapshot.coded:
            lists, self._centred = InvertedLists.built(snapshot.table, progress=self._report), snapshot.coded
        elif snapshot.lists is not None and snapshot.coded - lists.rows <= _UNLISTED_SHARE * snapshot.rows:
            return
        else:
            lists = lists.extended(snapshot.table)
        self._publish(lambda now: replace(now, lists=lists))
        self._files.write_lists(snapshot.table.coder, lists, self._centred, self._map.entries())

    # Recall

    def _measure(self) -> None:
        snapshot = self._map.snapshot()
        present = tier_of(snapshot)
        if snapshot.table is None:
            return
        if self._recall is None or self._recall[0] != present:
            with suppress(StaleArrays):
                self._recall = (present, self._files.read_recall(snapshot.table.coder, present))
        known = self._recall[1].places if self._recall is not None and self._recall[0] == present else 0
        if known * _GROWN >= len(snapshot):
            return
        found = measure_recall(snapshot, self._report)
        if found is not None:
            self._recall = (present, found)
            self._files.write_recall(snapshot.table.coder, present, found)

    # Back to exact search

    def _hold_all(self) -> None:
        """Read all descriptors into memory and drop the codes."""
        newest = self._publish(lambda now: replace(now, holds=True))
        for number, segment in enumerate(newest.segments):
            if segment.held is None and not segment.removed:
                self._hold(number)
            self._report(number + 1, len(newest.segments))
        self._publish(lambda now: replace(now, table=None, lists=None))
        with self._lock:
            self._recall = None
            self._written.clear()
        self._files.remove()

    def _hold(self, number: int) -> None:
        """Read the descriptors of a segment into memory; the last segment may grow meanwhile."""

        def read(now: Snapshot, before: Held | None) -> Held:
            first, count = now.segments[number].first_row, len(now.segments[number])
            done = 0 if before is None else before.index.ntotal
            rows = np.arange(first + done, first + count)
            index = flat_index(count, now.dimension, now.halves)
            local = np.zeros((count, *now.local_shape), np.int8)
            if before is not None:
                vectors(index)[:done], local[:done] = vectors(before.index), before.local
            vectors(index)[done:], local[done:] = now.descriptors_at(rows), now.locals_at(rows)
            return Held(index, local)

        newest = self._map.snapshot()
        if newest.segments[number].removed:
            return
        first = read(newest, None)
        self._publish(lambda now: now if now.segments[number].removed else now.holding(number, read(now, first)))
