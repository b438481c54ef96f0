"""Removing the segment files of deleted places: a full segment without a living row is removed.

The COMMIT that deletes the last place of a segment also records in SQLite that the segment is removed; its rows keep
their numbers.  The file is deleted right after the COMMIT or, while an older snapshot may still read it, before a later
write.  A crash in between leaves a file that nothing refers to, which the next start deletes.  So no file is ever
missing that SQLite refers to.  The last segment is never removed, and no row is ever moved: a single living place keeps
its segment.
"""

from __future__ import annotations

import logging
import threading
import weakref
from collections.abc import Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from core.ledger.maps.connection import MapConnection
from core.storage.database.segments import SegmentEntry, count_places_between, mark_removed
from core.storage.files.segment_files import Layout, segment_name
from core.storage.search.snapshot import Snapshot

log = logging.getLogger(__name__)


class RemovedSegments:
    """The removed segments of one map whose files are still there, because a snapshot may read them.

    Only the thread that writes may use this, except for :meth:`retained`.
    """

    def __init__(self, folder: Path, layout: Layout) -> None:
        """For the map in ``folder``, without waiting segments."""
        self._folder, self._layout = folder, layout
        self._waiting: dict[int, weakref.ref[object]] = {}
        self._suspects: set[int] | None = None  # segments that may have no living row; None: any of them
        self._lock, self._keepers = threading.Lock(), 0

    @contextmanager
    def retained(self) -> Iterator[None]:
        """Keep all files during the block, so that a transaction in it finds them.  Any thread may use this."""
        with self._lock:
            self._keepers += 1
        try:
            yield
        finally:
            with self._lock:
                self._keepers -= 1

    @property
    def in_use(self) -> bool:
        """Whether files have to stay for a transaction that reads them."""
        return self._keepers > 0

    @property
    def waiting(self) -> int:
        """How many files of removed segments are still there."""
        return len(self._waiting)

    def remove(self, connection: MapConnection, after: Snapshot, touched: Set[int] = frozenset()) -> Snapshot:
        """Record segments without a living row as removed; returns the snapshot to search after the COMMIT.

        Args:
            connection: within a transaction.
            after: the snapshot after the COMMIT, with these segments.
            touched: numbers of the segments in which a row died, and of those from the former last segment on.
        """
        size, segments = self._layout.rows_per_segment, list(after.segments)
        tail = len(segments) - 1
        suspects = range(tail) if self._suspects is None else sorted(self._suspects | touched)
        self._suspects = set()
        for number in suspects:
            if number >= tail or (segment := segments[number]).removed or segment.living:
                continue
            if places := count_places_between(connection, number * size, (number + 1) * size):
                log.error("%s is not removed: it has %s places that are not searched.", segment_name(number), places)
                continue
            mark_removed(connection, number)
            self._waiting[number] = weakref.ref(segment.reading)
            segments[number] = segment.without_rows()
        return after if tuple(segments) == after.segments else replace(after, segments=tuple(segments))

    def clear(self, current: Snapshot) -> None:
        """Delete the files of segments that are removed in ``current`` and that no snapshot can read.

        A segment that is not removed in ``current``, which was committed, is one whose COMMIT failed: its file stays.
        """
        for number, reading in [] if self._keepers else list(self._waiting.items()):
            is_removed = number < len(current.segments) and current.segments[number].removed
            if not is_removed and self._suspects is not None:
                self._suspects.add(number)
            if not is_removed or (reading() is None and _delete(self._folder / segment_name(number))):
                del self._waiting[number]


def clear_folder(folder: Path, entries: Sequence[SegmentEntry]) -> None:
    """Delete the files of removed segments of a map that is not open."""
    for segment in entries:
        if segment.removed:
            _delete(folder / segment_name(segment.number))


def _delete(path: Path) -> bool:
    """Delete a file; returns whether it is gone.  One that cannot be deleted does no harm."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        log.warning("%s is no longer needed but cannot be deleted now: %s", path.name, error)
        return False
    return True
