"""One write to a map, in SQLite, the segment files and the snapshot; and the repair of the files after a failed one."""

from __future__ import annotations

import logging
import sqlite3
from dataclasses import replace
from datetime import UTC, datetime
from math import nan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.disk.files import Damage, primary_code
from core.geometry.keypoints import Keypoints
from core.maps.records import Change, Enrolment, History, Keep, MapRecord, PicturedPlace, SameFrame
from core.maps.stored_fields import same_fields
from core.maps.views import MOST_HIDDEN, LatestViews, Look, latest_views, leaves_view, reach_of
from core.places import GEOGRAPHIC, METRIC, NO_POSE, NO_TIME, Place, PlaceFields, Pose, microseconds
from core.storage.database import keypoints, ledger
from core.storage.database.ledger import StoredPlace, segment_entries
from core.storage.files import segment_files as descriptors
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
    )


def record_appended(
    connection: sqlite3.Connection, layout: Layout, first_row: int, checksums: list[int]
) -> dict[int, int]:
    """Record in SQLite the rows that were appended to the segment files.

    Args:
        first_row: of those rows.
        checksums: of each row.

    Returns:
        The checksums of the segments that became full, by their numbers.
    """
    filled, done = {}, 0
    while done < len(checksums):
        number, offset = divmod(first_row + done, layout.rows_per_segment)
        part = checksums[done : done + layout.rows_per_segment - offset]
        before = connection.execute("SELECT checksum FROM segments WHERE number = ?", (number,)).fetchone()
        checksum = descriptors.segment_checksum(part, before[0] if before else 0)
        ledger.put_segment_entry(connection, number, offset + len(part), checksum)
        if offset + len(part) == layout.rows_per_segment:
            filled[number] = checksum
        done += len(part)
    return filled


class Write:
    """Collects the changes of one write within a transaction.

    ``finish`` makes the descriptors durable, which must happen before the COMMIT that refers to them.
    """

    def __init__(
        self, folder: Path, opened: OpenMap, record: MapRecord, snapshot: Snapshot, connection: sqlite3.Connection
    ):
        self.record = record
        self.connection = connection
        self.appending = False
        """Whether there may be rows in the segment files that SQLite does not refer to."""
        self.committing = False
        """Whether the end of the transaction may be in SQLite's log."""
        self.filled: dict[int, int] = {}
        """The checksums of the segments that became full, by their numbers."""
        self._folder = folder
        self._layout = opened.layout
        self._removed_segments = opened.removed_segments
        self._snapshot = snapshot
        self._records: NDArray[np.void] = np.zeros(0, opened.layout.record)
        self._appended = 0
        self._locations: list[Location] = []
        self._moved: dict[int, Location] = {}
        self._dead: list[int] = []
        self._latest: dict[str, LatestViews] = {}  # of the sequences that frames were added to
        self._now = datetime.now(UTC)

    def expect(self, frames: int) -> None:
        """Allocate room for more frames at once, so that none has to be copied later."""
        if (needed := self._appended + frames) > len(self._records):
            records = np.zeros(needed, self._layout.record)
            records[: self._appended] = self._records[: self._appended]
            self._records = records

    def enrol(self, item: Enrolment, keep: Keep | None = None, ordinal: int | None = None) -> tuple[Place, Change]:
        """Create a place, replace its frame, or change its fields if the frame is the same.

        Args:
            keep: the picture of the frame to store; by default that of the map's settings.
            ordinal: the position of a new place in its sequence; None: by its view, at the end of the sequence.
        """
        stored = ledger.find(self.connection, item.id)
        if stored is not None and stored.digest == item.digest:
            if item.keypoints is not None and not keypoints.are_stored(self.connection, stored.number):
                self._put_keypoints(stored, item.keypoints)
            return self.set_fields(stored, item.fields)
        row = self._snapshot.rows + self._appended
        if self._appended == len(self._records):
            self.expect(max(1, self._appended))
        record = self._records[self._appended]
        self._layout.pack(record, item.descriptor, item.local, row)
        checksum = int(record["checksum"])
        keep, look = self.record.keep if keep is None else keep, Look(item.descriptor, item.local, item.fields.pose)
        if stored is None:
            at = self._position(item.fields.sequence, look) if ordinal is None else ordinal
            now_stored = ledger.insert(self.connection, item, row, checksum, keep, self._now, at)
            self._note_last(now_stored, look)
        else:
            ledger.replace_descriptor(self.connection, stored, item, row, checksum, keep)
            keypoints.delete(self.connection, stored.number)
            now_stored = self._with_fields(stored, item.fields, look)
            self._mark_dead(stored.row)
        if item.keypoints is not None:
            self._put_keypoints(now_stored, item.keypoints)
        self._appended += 1
        self._locations.append(_location(now_stored))
        return now_stored.place, "created" if stored is None else "replaced"

    def _position(self, sequence: str | None, look: Look) -> int | None:
        """The position at the end of a sequence of a frame that shows a view which is there already, else None."""
        if sequence is None:
            return None
        if sequence not in self._latest:
            positions = min(self.record.same_place_frames, MOST_HIDDEN)
            last, first = ledger.latest_in_sequence(self.connection, sequence, positions)
            self._latest[sequence] = latest_views(last, first, positions, self._reach, self._looks)
        return self._latest[sequence].position_of(look)

    def _note_last(self, stored: StoredPlace, look: Look) -> None:
        if (views := self._latest.get(stored.place.sequence or "")) is not None:
            views.note(stored.ordinal, look)

    def _looks(self, rows: list[int]) -> list[Look]:
        """The content of the frames in some rows, those of this write included."""
        poses = {row: stored.place.pose for row, stored in ledger.stored_at(self.connection, rows).items()}
        before = self._snapshot.rows
        old = np.array([row for row in rows if row < before], np.int64)
        new = self._records[[row - before for row in rows if row >= before]]
        stored = zip(self._snapshot.descriptors_at(old), self._snapshot.locals_at(old), strict=True)
        pending = zip(self._layout.descriptors_of(new), self._layout.locals_of(new), strict=True)
        shown = dict(zip(old.tolist(), stored, strict=True))
        shown |= dict(zip([row for row in rows if row >= before], pending, strict=True))
        return [Look(shown[row][0], shown[row][1], poses[row]) for row in rows]

    def _with_fields(self, stored: StoredPlace, fields: PlaceFields, look: Look | None = None) -> StoredPlace:
        """Change the fields of a place.

        Args:
            look: the look of its new frame; None: its frame stays.
        """
        moves = fields.sequence != stored.place.sequence
        leaves = not moves and self._leaves(stored, fields, look)
        at = None
        if moves or leaves:
            at = self._position(fields.sequence, look or replace(self._looks([stored.row])[0], pose=fields.pose))
        self._latest.clear()
        now_stored = ledger.set_fields(self.connection, stored, fields, self._now, at)
        return ledger.move(self.connection, now_stored, at) if leaves else now_stored

    def _leaves(self, stored: StoredPlace, fields: PlaceFields, look: Look | None) -> bool:
        """Whether a place whose sequence stays does not belong to its position any more, because of a change."""
        if fields.sequence is None or (look is None and fields.pose == stored.place.pose):
            return False
        first = ledger.first_at(self.connection, stored.sequence, stored.ordinal, before=stored.number)
        if first is None:
            return False
        rows = [] if look is None else ledger.beside(self.connection, stored)
        began, *others = self._looks([first, *rows])
        return leaves_view(fields.pose, look, began, others, self._reach)

    @property
    def _reach(self) -> float:
        return reach_of(self.record.same_place_radius)

    def _put_keypoints(self, stored: StoredPlace, found: Keypoints) -> None:
        if self.record.verification:
            keypoints.put(self.connection, stored.number, stored.digest, found.record())

    def add_keypoints(self, frame: PicturedPlace, found: Keypoints) -> bool:
        """Store the keypoints of a place that has none, if it still shows the frame; returns whether it does."""
        stored = ledger.find(self.connection, frame.id)
        if stored is None or stored.digest != frame.digest or keypoints.are_stored(self.connection, stored.number):
            return False
        self._put_keypoints(stored, found)
        return self.record.verification

    def renew(self, item: SameFrame) -> tuple[Place, Change] | None:
        """Change the fields of a place that shows this frame; None if it shows another frame or is gone."""
        stored = ledger.find(self.connection, item.id)
        return None if stored is None or stored.digest != item.digest else self.set_fields(stored, item.fields)

    def adopt(self, item: Enrolment, history: History) -> None:
        """Store a place of another map with its history."""
        self.enrol(item, history.picture, history.ordinal)
        self._latest.clear()
        stored = ledger.set_history(self.connection, item.id, history)
        appended = stored.row - self._snapshot.rows
        if appended >= 0:
            self._locations[appended] = _location(stored)
        else:
            self._moved[stored.row] = _location(stored)

    def set_fields(self, stored: StoredPlace, fields: PlaceFields) -> tuple[Place, Change]:
        """Change the fields of a place; its frame stays."""
        if same_fields(stored.place, fields):
            return stored.place, "unchanged"
        now_stored = self._with_fields(stored, fields)
        self._moved[stored.row] = _location(now_stored)
        return now_stored.place, "updated"

    def set_counterpart(
        self, stored: StoredPlace, track: int | None, station: int | None, pose: Pose | None, pose_of: str | None
    ) -> None:
        """Set the station of a place, None for its own, its pose and the place from which it got the pose."""
        at = None if track is None or station is None else (track, station)
        at = None if at == (stored.sequence, stored.ordinal) else at
        now_stored = ledger.set_counterpart(self.connection, stored, at, pose, pose_of, self._now)
        self._moved[stored.row] = _location(now_stored)

    def forget(self, stored: StoredPlace) -> None:
        """Delete a place."""
        ledger.delete(self.connection, stored)
        self._latest.clear()
        self._mark_dead(stored.row)

    def forget_sequence(self, name: str) -> int:
        """Delete the places of a sequence; returns how many."""
        rows = ledger.rows_of_sequence(self.connection, name)
        if rows:
            ledger.delete_sequence(self.connection, name)
            self._latest.clear()
            for row in rows:
                self._mark_dead(row)
        return len(rows)

    def edit(self, record: MapRecord) -> None:
        """Replace the map's record, with the next revision."""
        changed = {"revision": self.record.revision + 1, "updated_at": self._now}
        self.record = record.model_copy(update=changed)
        ledger.update_record(self.connection, self.record)

    def _mark_dead(self, row: int) -> None:
        self._dead.append(row)
        self._moved.pop(row, None)

    def finish(self) -> Snapshot:
        """Append and sync the descriptors, and record them in SQLite; returns the snapshot after the COMMIT.

        Raises:
            OSError, sqlite3.Error: the disk refuses.
        """
        before = self._snapshot
        if self._appended:
            self.appending = True
            records = self._records[: self._appended]
            descriptors.append(self._folder, self._layout, before.rows, records)
            self.filled = record_appended(self.connection, self._layout, before.rows, records["checksum"].tolist())
            # Halves are held in memory as they are stored.
            vectors = records["descriptor"] if before.halves else self._layout.descriptors_of(records)
            local = self._layout.locals_of(records)
            after = before.appended(vectors, self._locations, local, records["checksum"].tolist())
        else:
            after = before
        after = after.moved(self._moved) if self._moved else after
        after = after.without(self._dead) if self._dead else after
        size, first_new = self._layout.rows_per_segment, max(0, len(before.segments) - 1)
        touched = {row // size for row in self._dead} | set(range(first_new, len(after.segments)))
        # The former snapshot is let go, so that its memory and its files can be.
        self._snapshot = self._removed_segments.remove(self.connection, after, touched)
        self.committing = True
        return self._snapshot


class FailedWrites:
    """Remembers rows that a failed write may have left in the files of a map, and removes them before the next one.

    Only the thread that writes may use this.
    """

    def __init__(self, folder: Path) -> None:
        """For the map in ``folder``, whose writes have not failed."""
        self._folder = folder
        self._rows = False
        self._log = False

    def note(self, error: BaseException, write: Write, opened: OpenMap, rows: int) -> None:
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
            descriptors.rewind(self._folder, opened.layout, rows)
            # The failed sync may also have lost a block that holds the end of the last good row.
            with opened.database.reading() as connection:
                entries = segment_entries(connection, opened.layout)
            if sum(segment.rows for segment in entries) != rows:
                raise Damage("map.sqlite refers to other rows than were written")
            for last in entries[-1:]:
                for _ in descriptors.read_checked(self._folder, opened.layout, last.number, last.rows, last.checksum):
                    pass
            self._rows = False
