"""One write to a map in a data directory: files and snapshot; and the repair of the files after a failed one."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Sequence
from dataclasses import replace
from math import inf, nan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.disk.files import Damage, primary_code
from core.ledger.maps import frames
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.places import StoredPlace
from core.ledger.maps.record import MapState
from core.ledger.maps.writing import Descriptors, Write
from core.maps.records import Enrolment
from core.places import GEOGRAPHIC, METRIC, NO_POSE, NO_TIME, level_code, microseconds
from core.storage.database.segments import record_appended, segment_entries
from core.storage.files import segment_files
from core.storage.files.segment_files import Layout
from core.storage.opening import OpenMap
from core.storage.search.segment import Location
from core.storage.search.snapshot import Snapshot

log = logging.getLogger(__name__)


def _location(stored: StoredPlace) -> Location:
    """Where a place is as the snapshot holds it."""
    pose, moment = stored.place.pose, stored.place.timestamp
    kind = NO_POSE if pose is None else METRIC if pose.kind() == "metric" else GEOGRAPHIC
    x, y, z = (0.0, 0.0, 0.0) if pose is None else pose.position().tolist()
    return Location(
        kind,
        (x, y, z),
        stored.sequence,
        stored.ordinal,
        nan if pose is None or pose.heading is None else pose.heading,
        NO_TIME if moment is None else microseconds(moment),
        stored.track,
        stored.station,
        -inf if stored.least is None else stored.least,
        level_code(stored.place.level),
        nan if pose is None or pose.z is None else pose.z,
        getattr(stored.place.pose_accuracy, "metres", nan),
    )


class AppendingWrite(Write):
    """A write whose descriptors are appended to the segment files of a folder when it is finished."""

    def __init__(self, connection: MapConnection, state: MapState, folder: Path, layout: Layout) -> None:
        super().__init__(connection, state)
        self.appending = False
        """Whether there may be rows in the segment files that SQLite does not refer to."""
        self.committing = False
        """Whether the end of the transaction may be in SQLite's log."""
        self.filled: dict[int, int] = {}
        """The checksums of the segments that became full, by their numbers."""
        self._folder, self._layout = folder, layout
        self._records: NDArray[np.void] = np.zeros(0, layout.record)
        self._appended = 0

    def expect(self, count: int) -> None:
        """Allocate room for more frames at once, so that none has to be copied later."""
        if (needed := self._appended + count) > len(self._records):
            records = np.zeros(needed, self._layout.record)
            records[: self._appended] = self._records[: self._appended]
            self._records = records

    def add_stored(self, frame: NDArray[np.void]) -> int:
        """Take the next row's descriptors as they are stored (:attr:`Layout.frame`); returns its checksum."""
        row = self._next_row()
        (made,) = self._layout.records_of(frame, row)
        self._records[self._appended] = made
        self._appended += 1
        self.state = replace(self.state, rows=row + 1)
        return int(made["checksum"])

    def _next_row(self) -> int:
        if self._appended == len(self._records):
            self.expect(max(1, self._appended))
        return self._before.rows + self._appended

    def _add_descriptors(self, row: int, item: Enrolment) -> int:
        at = self._next_row() - self._before.rows  # this may replace the records
        record = self._records[at]
        self._layout.pack(record, item.descriptor, item.local, row)
        self._appended += 1
        return int(record["checksum"])

    def _descriptors_at(self, rows: Sequence[int]) -> list[Descriptors]:
        new = self._records[[row - self._before.rows for row in rows]]
        return list(zip(self._layout.descriptors_of(new), self._layout.locals_of(new), strict=True))

    def _let_go(self, stored: StoredPlace) -> None:
        frames.delete_frames(self.connection, [stored.row])

    def _note(self, stored: StoredPlace) -> None:
        """Do nothing: the files do not know where places are."""

    def _finish(self) -> None:
        if self._appended:
            self.appending = True
            records = self._records[: self._appended]
            segment_files.append(self._folder, self._layout, self._before.rows, records)
            sums = records["checksum"].tolist()
            self.filled = record_appended(self.connection, self._layout, self._before.rows, sums)


class FileWrite(AppendingWrite):
    """A write to an open map, of which it makes the next snapshot.

    after: the snapshot to search after the COMMIT, once the write is finished.
    """

    def __init__(
        self, folder: Path, opened: OpenMap, state: MapState, snapshot: Snapshot, connection: MapConnection
    ) -> None:
        super().__init__(connection, state, folder, opened.layout)
        self.after = snapshot
        self._removed_segments = opened.removed_segments
        self._locations: list[Location] = []
        self._moved: dict[int, Location] = {}
        self._dead: list[int] = []

    def _descriptors_at(self, rows: Sequence[int]) -> list[Descriptors]:
        old = np.array([row for row in rows if row < self._before.rows], np.int64)
        stored = zip(self.after.descriptors_at(old), self.after.locals_at(old), strict=True)
        shown = dict(zip(old.tolist(), stored, strict=True))
        new = [row for row in rows if row >= self._before.rows]
        shown |= dict(zip(new, super()._descriptors_at(new), strict=True))
        return [shown[row] for row in rows]

    def _note(self, stored: StoredPlace) -> None:
        new = stored.row - self._before.rows
        if new < 0:
            self._moved[stored.row] = _location(stored)
        elif new == len(self._locations):
            self._locations.append(_location(stored))
        else:
            self._locations[new] = _location(stored)

    def _let_go(self, stored: StoredPlace) -> None:
        super()._let_go(stored)
        self._dead.append(stored.row)
        self._moved.pop(stored.row, None)

    def _finish(self) -> None:
        before, records = self.after, self._records[: self._appended]
        super()._finish()
        after = before
        if self._appended:
            # Halves are held in memory as they are stored.
            vectors = records["descriptor"] if before.halves else self._layout.descriptors_of(records)
            local = self._layout.locals_of(records)
            after = before.appended(vectors, self._locations, local, records["checksum"].tolist())
        after = after.moved(self._moved) if self._moved else after
        after = after.without(self._dead) if self._dead else after
        size, first_new = self._layout.rows_per_segment, max(0, len(before.segments) - 1)
        touched = {row // size for row in self._dead} | set(range(first_new, len(after.segments)))
        # The former snapshot is let go, so that its memory and its files can be.
        self.after = self._removed_segments.remove(self.connection, after, touched)
        self.committing = True


class FailedWrites:
    """Remembers rows that a failed write may have left in the files of a map, and removes them before the next one.

    Only the thread that writes may use this.
    """

    def __init__(self, folder: Path) -> None:
        """For the map in ``folder``, whose writes have not failed."""
        self._folder = folder
        self._rows = False
        self._log = False

    def note(self, error: BaseException, write: AppendingWrite, opened: OpenMap, rows: int) -> None:
        """Note that a write failed with ``error``, and try to repair the files at once.

        A write that failed before it appended rows or began its COMMIT has left nothing.  A COMMIT that found no room
        has not written the end of its transaction; after any other failed COMMIT the log must be emptied, because
        SQLite would replay the transaction after a crash.

        Args:
            rows: of the map before the write.
        """
        found_no_room = isinstance(error, sqlite3.Error) and primary_code(error) == sqlite3.SQLITE_FULL
        self._rows |= write.appending
        self._log |= write.committing and not found_no_room
        try:
            self.repair(opened, rows)
        except (OSError, sqlite3.Error, Damage) as further:
            log.warning("Map %s takes no writes until its files are repaired: %s", self._folder.name, further)

    def repair(self, opened: OpenMap, rows: int) -> None:
        """Bring the files back to the ``rows`` rows of the last successful write; no write begins before this succeeds.

        Raises:
            OSError, sqlite3.Error: the disk refuses.
            Damage: rows of successful writes are missing or damaged.
        """
        if self._log:
            opened.database.empty_log()
            self._log = False
        if self._rows:
            segment_files.rewind(self._folder, opened.layout, rows)
            # The failed sync may also have lost a block that holds the end of the last good row.
            with opened.database.reading() as connection:
                entries = segment_entries(connection, opened.layout)
            if sum(segment.rows for segment in entries) != rows:
                raise Damage("map.sqlite refers to other rows than were written")
            for last in entries[-1:]:
                for _ in segment_files.read_checked(self._folder, opened.layout, last.number, last.rows, last.checksum):
                    pass
            self._rows = False
