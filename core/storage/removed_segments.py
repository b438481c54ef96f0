"""Giving back the room of places that were deleted: a full segment of which no row is alive any more is removed.

What counts is SQLite: the COMMIT that deletes the last place of a segment also says that the segment is removed, and
its rows keep their numbers.  The file goes right after it, or, if a snapshot is left that might read it, before the
next write that finds none: a full disk may need its room for that.  A crash in between leaves a file that nothing
needs, which the next start clears away.  So there is no moment at which a file is missing that anything names.  The
tail is never removed, and no row is ever moved: one place that lives keeps its segment.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import weakref
from collections.abc import Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from core.storage.database.ledger import NamedSegment
from core.storage.files.segment_files import Layout, segment_name
from core.storage.search.snapshot import Snapshot

log = logging.getLogger(__name__)


class RemovedSegments:
    """Files of one map that nothing names any more, until nobody reads them.  For the thread that writes."""

    def __init__(self, folder: Path, layout: Layout) -> None:
        """Of the map in ``folder``: none yet."""
        self._folder, self._layout = folder, layout
        self._waiting: dict[int, weakref.ref[object]] = {}
        self._suspects: set[int] | None = None  # segments that may be without life; None: any, nobody has looked
        self._lock, self._keepers = threading.Lock(), 0

    @contextmanager
    def kept(self) -> Iterator[None]:
        """No file goes within: what a transaction names that begins within is there.  From any thread."""
        with self._lock:
            self._keepers += 1
        try:
            yield
        finally:
            with self._lock:
                self._keepers -= 1

    def remove(self, connection: sqlite3.Connection, after: Snapshot, touched: Set[int] = frozenset()) -> Snapshot:
        """Name the segments without a living row as removed, within a transaction; what is to be searched then.

        Args:
            after: what would be searched after the COMMIT.
            touched: numbers of segments in which a row died, and of those from the former tail on.
        """
        size, segments = self._layout.rows_per_segment, list(after.segments)
        tail = len(segments) - 1
        suspects = range(tail) if self._suspects is None else sorted(self._suspects | touched)
        self._suspects = set()
        for number in suspects:
            if number >= tail or (segment := segments[number]).removed or segment.has_life:
                continue
            query = "SELECT count(*) FROM places WHERE row >= ? AND row < ?"
            (places,) = connection.execute(query, (number * size, (number + 1) * size)).fetchone()
            if places:
                log.error("%s has %s places that are not searched; it stays.", segment_name(number), places)
                continue
            connection.execute("UPDATE segments SET removed = 1 WHERE number = ?", (number,))
            self._waiting[number] = weakref.ref(segment.reading)
            segments[number] = segment.without_rows()
        return after if tuple(segments) == after.segments else replace(after, segments=tuple(segments))

    def clear(self, current: Snapshot) -> None:
        """Delete the files of segments that ``current``, which was committed, has removed and nobody can read.

        A segment that it has not removed is one whose COMMIT failed: it stays.
        """
        for number, reading in [] if self._keepers else list(self._waiting.items()):
            is_removed = number < len(current.segments) and current.segments[number].removed
            if not is_removed and self._suspects is not None:
                self._suspects.add(number)
            if not is_removed or (reading() is None and _delete(self._folder / segment_name(number))):
                del self._waiting[number]


def clear_folder(folder: Path, named: Sequence[NamedSegment]) -> None:
    """Delete the files of removed segments of a map that nobody has open."""
    for segment in named:
        if segment.removed:
            _delete(folder / segment_name(segment.number))


def _delete(path: Path) -> bool:
    """Whether the file is gone; one that the disk keeps does no harm."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        log.warning("%s is not needed any more and stays for now: %s", path.name, error)
        return False
    return True
