"""Bringing a map to the tier that it is to have, in the background.

One thread a map, there only while there is work.  It reads rows and makes codes of them without holding anything up,
and publishes what it has made as a new snapshot, a few hundred rows at a time: searches go on in what is there, and
rows without a code are compared exactly.  What it made is kept in files (:mod:`core.storage.search.index_files`), so
that after a kill it goes on where the last whole file ends.
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
from core.storage.database.ledger import NamedSegment
from core.storage.files.arrays import StaleArrays
from core.storage.search.index_files import IndexFiles
from core.storage.search.rebuilding import codes_of, fitted_coder, remade
from core.storage.search.recall import measured
from core.storage.search.segment import Held, flat_index, vectors
from core.storage.search.snapshot import Snapshot, threads
from core.storage.search.tiers import IndexStatus, Recall, Tier, TierSetting, tier_for

log = logging.getLogger(__name__)

_ROWS_AT_ONCE = 256
_NICENESS = 10
_PATIENCE_SECONDS = 0.1
_UNLISTED_SHARE = 0.02
_GROWN = 2  # so many times as many places as when it was measured, the recall is measured again


class Stopped(Exception):
    """The map was closed; raised within the thread that builds."""


@dataclass(frozen=True)
class IndexedMap:
    """What is built for.

    setting: the tier that its owner chose.
    snapshot: the newest.
    publish: puts a change of the newest snapshot in its place, no write coming in between; raises Stopped when the
        map was closed.
    named: what SQLite says of the segments.
    quarantine: the map turns out to be damaged.
    """

    setting: Callable[[], TierSetting]
    snapshot: Callable[[], Snapshot]
    publish: Callable[[Callable[[Snapshot], Snapshot]], Snapshot]
    named: Callable[[], Sequence[NamedSegment]]
    quarantine: Callable[[Damage], None]


def tier_of(snapshot: Snapshot) -> Tier:
    """How it is searched."""
    if snapshot.table is None:
        return "exact"
    return "compact" if snapshot.lists is None else "inverted"


class Indexer:
    """Builds what one map is searched by.  From any thread."""

    def __init__(self, of: IndexedMap, files: IndexFiles) -> None:
        """For an open map."""
        self._map = of
        self._files = files
        self._lock = threading.Lock()
        self._building = threading.Lock()  # held by the one thread that builds
        self._thread: threading.Thread | None = None
        self.problem: str | None = None
        """Why the last attempt to build came to no end, if it did not."""
        self._again = False
        self._stopping = threading.Event()
        self._progress = 0.0
        self._recall: tuple[Tier, Recall] | None = None
        self._written: set[tuple[NamedSegment, ...]] = set()
        self._centred = 0  # rows when the centres of the lists were found

    def wake(self) -> None:
        """See whether there is anything to build, and begin with it."""
        with self._lock:
            if self._stopping.is_set():
                return
            self._again = True
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="index", daemon=True)
                self._thread.start()

    def stop(self, wait: bool = True) -> None:
        """End what is under way; what was published stays.

        Args:
            wait: until it has ended; not from within the map's lock.
        """
        with self._lock:
            self._stopping.set()
            thread = self._thread if wait else None
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def status(self, newest: Callable[[], Snapshot | None]) -> IndexStatus | None:
        """How the map is searched; None where there is no snapshot any more.

        Args:
            newest: gives the newest snapshot.  It is taken when it is known whether anything is being built, or what
                was just built could be said to be ready and not to be there.
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
        """Whether anything is to be built for a snapshot; cheap."""
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
        threads()  # begun by a thread that is not nice, for those that search with them have to wait for them
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
                    self._settle()
                self.problem = None
                if self._wanted(self._map.snapshot()) != wanted:  # by a write that found nothing built yet
                    with self._lock:
                        self._again = True
            except (Stopped, UnknownMap, MapQuarantined):
                pass
            except Damage as damage:
                self._map.quarantine(damage)
            except Exception:
                # It is tried again with the next write or start; searches go on in what there is.
                log.exception("What a map is searched by could not be built to the end.")
                self.problem = "what the map is searched by could not be built to the end; the log says why"

    def _settle(self) -> None:
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

    def _told(self, done: int, total: int) -> None:
        if self._stopping.is_set():
            raise Stopped
        self._progress = done / max(1, total)

    def rebuild(self, progress: Callable[[int, int], None]) -> None:
        """Make all of it anew from the descriptors, and put it in the place of what is there, which serves until then.

        Args:
            progress: told of rows done and of all; what it raises leaves everything as it was.

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
            made = remade(self._map.snapshot, wanted == "inverted", told)
            self._publish(made.put_into)
            self._files.write_coder(made.table.coder)
            self._written.clear()
            self._recall = None
            self._keep_codes()
            if made.lists is not None:
                self._centred = made.lists.rows
                self._files.write_lists(made.table.coder, made.lists, self._centred, self._map.named())
        finally:
            self._building.release()
            self.wake()

    # Codes

    def _code_all(self) -> None:
        """A code for every row, and no descriptor in memory."""
        newest = self._map.snapshot()
        if newest.table is None:
            coder = self._coder(newest)
            newest = self._publish(lambda now: replace(now, table=CodeTable.empty(coder), holds=False))
        elif newest.holds:
            newest = self._publish(lambda now: replace(now, holds=False))
        while newest.coded < newest.rows:
            assert newest.table is not None
            newest = self._code_group(newest.table.coder, newest.coded)
            self._told(newest.coded, newest.rows)
        for number, segment in enumerate(newest.segments):
            if segment.held is not None:
                self._publish(lambda now, number=number: now.holding(number, None))  # type: ignore[misc]

    def _coder(self, snapshot: Snapshot) -> Coder:
        try:
            return self._files.read_coder()
        except StaleArrays as stale:
            log.info("The codes of a map are made: coder.index: %s.", stale)
        coder = fitted_coder(snapshot)
        self._files.write_coder(coder)
        return coder

    def _code_group(self, coder: Coder, start: int) -> Snapshot:
        """Codes of the next rows: from the group's file if they begin one that has a good one, else made."""
        named = self._map.named()
        newest = self._map.snapshot()
        per_segment = newest.rows_per_segment
        group = start // per_segment // self._files.group_size
        of_group = self._files.named_group(named, group)
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
        if stop == sum(segment.rows for segment in named[: (group + 1) * self._files.group_size]):
            self._keep_group(of_group)
        return newest

    def _keep_group(self, of_group: Sequence[NamedSegment]) -> None:
        snapshot = self._map.snapshot()
        first = of_group[0].number * snapshot.rows_per_segment
        if tuple(of_group) in self._written or snapshot.table is None:
            return
        codes = snapshot.table.codes(first, first + sum(segment.rows for segment in of_group))
        if self._files.write_codes(snapshot.table.coder, of_group, codes):
            self._written.add(tuple(of_group))

    def _keep_codes(self) -> None:
        """The codes of every whole group in its file, those that the writer made included."""
        named = self._map.named()
        for group in range(len(named) // self._files.group_size):
            of_group = self._files.named_group(named, group)
            if of_group[-1].rows == of_group[0].rows:
                self._told(group, len(named))
                self._keep_group(of_group)

    def keep_tail(self, snapshot: Snapshot, named: Sequence[NamedSegment]) -> None:
        """The codes of the last group, which is not whole, so that the next start need not make them again."""
        of_group = self._files.named_group(named, max(0, len(named) - 1) // self._files.group_size)
        if of_group and snapshot.table is not None and snapshot.coded == snapshot.rows:
            first = of_group[0].number * snapshot.rows_per_segment
            if tuple(of_group) not in self._written:
                self._files.write_codes(snapshot.table.coder, of_group, snapshot.table.codes(first, snapshot.rows))

    # Lists

    def _list_all(self) -> None:
        """Lists of nearly all rows; the few others are searched one by one."""
        snapshot = self._map.snapshot()
        assert snapshot.table is not None
        lists = snapshot.lists
        if lists is None or not self._centred:  # those that the map was opened with tell when they were found
            with suppress(StaleArrays):
                named = self._map.named()
                lists, self._centred = self._files.read_lists(snapshot.table.coder, snapshot.coded, named)
        # Centres fit the places there were; of twice as many they are found again.
        if lists is None or 2 * self._centred < snapshot.coded:
            lists, self._centred = InvertedLists.built(snapshot.table, progress=self._told), snapshot.coded
        elif snapshot.lists is not None and snapshot.coded - lists.rows <= _UNLISTED_SHARE * snapshot.rows:
            return
        else:
            lists = lists.extended(snapshot.table)
        self._publish(lambda now: replace(now, lists=lists))
        self._files.write_lists(snapshot.table.coder, lists, self._centred, self._map.named())

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
        found = measured(snapshot, self._told)
        if found is not None:
            self._recall = (present, found)
            self._files.write_recall(snapshot.table.coder, present, found)

    # Back to exact search

    def _hold_all(self) -> None:
        """Every descriptor in memory, and no codes."""
        newest = self._publish(lambda now: replace(now, holds=True))
        for number, segment in enumerate(newest.segments):
            if segment.held is None and not segment.removed:
                self._hold(number)
            self._told(number + 1, len(newest.segments))
        self._publish(lambda now: replace(now, table=None, lists=None))
        with self._lock:
            self._recall = None
            self._written.clear()
        self._files.remove()

    def _hold(self, number: int) -> None:
        """The descriptors of a segment in memory; it may grow meanwhile, if it is the last."""

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
