"""One write to a map: what it changes in SQLite, in the segment files and in the snapshot."""

from __future__ import annotations

import logging
import sqlite3
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.disk.files import Damage, primary_code
from core.errors import NoRegions
from core.places import Place, PlaceFields, check_place_id
from core.storage.database import ledger
from core.storage.database.ledger import StoredPlace, named_segments
from core.storage.files import segment_files as descriptors
from core.storage.files.row_formats import LARGEST_HALF
from core.storage.files.segment_files import Layout
from core.storage.opening import OpenMap, location_of
from core.storage.records import Change, Enrolment, History, Keep, MapRecord, SameFrame
from core.storage.search.snapshot import Location, Snapshot

log = logging.getLogger(__name__)


def check_enrolment(item: Enrolment, dimension: int, local_shape: tuple[int, int]) -> None:
    """Refuse what a map cannot hold before anything is written.

    Args:
        dimension, local_shape: of the map's descriptors, D and (C, L).

    Raises:
        InvalidIdentifier: the id does not have the form of one.
        NoRegions: the descriptor is all zero.
        ValueError: descriptors or a digest of the wrong kind, which is the caller's mistake.
    """
    check_place_id(item.id)
    descriptor = item.descriptor
    if descriptor.dtype != np.float32 or descriptor.shape != (dimension,):
        raise ValueError(f"a descriptor of this map is float32 [{dimension}]")
    if item.local.dtype != np.int8 or item.local.shape != local_shape:
        raise ValueError(f"the local descriptors of a frame of this map are int8 {list(local_shape)}")
    with np.errstate(over="ignore"):
        squares = float(np.dot(descriptor, descriptor))
    if not np.isfinite(squares):
        raise ValueError("a descriptor is finite")
    if np.abs(descriptor).max() > LARGEST_HALF:
        raise ValueError(f"the values of a descriptor are within ±{LARGEST_HALF:.0f}")
    if squares == 0:
        raise NoRegions(f"The frame for place {item.id!r} has no region of interest, so it cannot be enrolled.")
    if len(item.digest) != 32:
        raise ValueError("a digest is the 32 bytes of SHA-256")
    if item.regions < 0:
        raise ValueError("a frame cannot have fewer than no regions")


def _location(stored: StoredPlace) -> Location:
    return location_of(stored.place.pose, stored.sequence, stored.ordinal, stored.place.timestamp)


def name_appended(
    connection: sqlite3.Connection, layout: Layout, first_row: int, checksums: list[int]
) -> dict[int, int]:
    """Name the rows, from ``first_row`` on, that were appended to the segment files.

    Returns:
        The segments that became full, and their checksums.
    """
    filled, done = {}, 0
    while done < len(checksums):
        number, offset = divmod(first_row + done, layout.rows_per_segment)
        part = checksums[done : done + layout.rows_per_segment - offset]
        named = connection.execute("SELECT checksum FROM segments WHERE number = ?", (number,)).fetchone()
        checksum = descriptors.chain(part, named[0] if named else 0)
        ledger.name_rows(connection, number, offset + len(part), checksum)
        if offset + len(part) == layout.rows_per_segment:
            filled[number] = checksum
        done += len(part)
    return filled


class Write:
    """Collects changes within a transaction of the map's one writer.

    ``finish`` makes the descriptors durable, which must come before the COMMIT that names them.
    """

    def __init__(
        self, folder: Path, opened: OpenMap, record: MapRecord, snapshot: Snapshot, connection: sqlite3.Connection
    ):
        self.record = record
        self.connection = connection
        self.appending = False
        """From here on there may be rows in the segment files that nothing names."""
        self.committing = False
        """From here on the end of the transaction may be in SQLite's log."""
        self.filled: dict[int, int] = {}
        """The segments that became full, and their checksums."""
        self._folder = folder
        self._layout = opened.layout
        self._removed_segments = opened.removed_segments
        self._snapshot = snapshot
        self._records: NDArray[np.void] = np.zeros(0, opened.layout.record)
        self._born = 0
        self._locations: list[Location] = []
        self._moved: dict[int, Location] = {}
        self._dead: list[int] = []
        self._now = datetime.now(UTC)

    def expect(self, frames: int) -> None:
        """Make room for so many more frames: those that there are would have to be moved for it later."""
        if (needed := self._born + frames) > len(self._records):
            records = np.zeros(needed, self._layout.record)
            records[: self._born] = self._records[: self._born]
            self._records = records

    def enrol(self, item: Enrolment, keep: Keep | None = None) -> tuple[Place, Change]:
        """Create a place, replace its frame, or give it other fields if the frame is the same.

        Args:
            keep: what to keep of the frame; the map's own rule if left out.
        """
        stored = ledger.find(self.connection, item.id)
        if stored is not None and stored.digest == item.digest:
            return self.set_fields(stored, item.fields)
        row = self._snapshot.rows + self._born
        if self._born == len(self._records):
            self.expect(max(1, self._born))
        record = self._records[self._born]
        self._layout.pack(record, item.descriptor, item.local, row)
        checksum = int(record["checksum"])
        keep = self.record.keep if keep is None else keep
        if stored is None:
            now_stored = ledger.insert(self.connection, item, row, checksum, keep, self._now)
        else:
            ledger.replace_descriptor(self.connection, stored, item, row, checksum, keep)
            now_stored = ledger.set_fields(self.connection, stored, item.fields, self._now)
            self._bury(stored.row)
        self._born += 1
        self._locations.append(_location(now_stored))
        return now_stored.place, "created" if stored is None else "replaced"

    def renew(self, item: SameFrame) -> tuple[Place, Change] | None:
        """Other fields for a place that shows this frame; None, and nothing, if it shows another or is gone."""
        stored = ledger.find(self.connection, item.id)
        return None if stored is None or stored.digest != item.digest else self.set_fields(stored, item.fields)

    def adopt(self, item: Enrolment, history: History) -> None:
        """A place of another map, with its history."""
        self.enrol(item, history.picture)
        stored = ledger.set_history(self.connection, item.id, history)
        born = stored.row - self._snapshot.rows
        if born >= 0:
            self._locations[born] = _location(stored)
        else:
            self._moved[stored.row] = _location(stored)

    def set_fields(self, stored: StoredPlace, fields: PlaceFields) -> tuple[Place, Change]:
        """Other fields for the same frame."""
        if ledger.same_fields(stored.place, fields):
            return stored.place, "unchanged"
        now_stored = ledger.set_fields(self.connection, stored, fields, self._now)
        self._moved[stored.row] = _location(now_stored)
        return now_stored.place, "updated"

    def forget(self, stored: StoredPlace) -> None:
        """Delete a place."""
        ledger.delete(self.connection, stored)
        self._bury(stored.row)

    def forget_sequence(self, name: str) -> int:
        """Delete the places of a sequence; returns how many there were."""
        rows = ledger.rows_of_sequence(self.connection, name)
        if rows:
            ledger.delete_sequence(self.connection, name)
            for row in rows:
                self._bury(row)
        return len(rows)

    def edit(self, record: MapRecord) -> None:
        """Put another record in the place of the map's, under the next revision."""
        changed = {"revision": self.record.revision + 1, "updated_at": self._now}
        self.record = record.model_copy(update=changed)
        ledger.update_record(self.connection, self.record)

    def _bury(self, row: int) -> None:
        self._dead.append(row)
        self._moved.pop(row, None)

    def finish(self) -> Snapshot:
        """Append and sync the descriptors, and name them; returns what is to be searched after the COMMIT.

        Raises:
            OSError, sqlite3.Error: the disk refuses.
        """
        before = self._snapshot
        if self._born:
            self.appending = True
            records = self._records[: self._born]
            descriptors.append(self._folder, self._layout, before.rows, records)
            self.filled = name_appended(self.connection, self._layout, before.rows, records["checksum"].tolist())
            # In memory as they are at rest, where that is the same.
            vectors = records["descriptor"] if before.halves else self._layout.descriptors_of(records)
            local = self._layout.locals_of(records)
            after = before.appended(vectors, self._locations, local, records["checksum"].tolist())
        else:
            after = before
        after = after.moved(self._moved) if self._moved else after
        after = after.without(self._dead) if self._dead else after
        size, first_new = self._layout.rows_per_segment, max(0, len(before.segments) - 1)
        touched = {row // size for row in self._dead} | set(range(first_new, len(after.segments)))
        self._snapshot = self._removed_segments.remove(self.connection, after, touched)  # what was before may go
        self.committing = True
        return self._snapshot


class FailedWrites:
    """What stands behind what was acknowledged last, in the segment files and in SQLite's log of one map?

    For the thread that writes.
    """

    def __init__(self, folder: Path) -> None:
        """Of the map in ``folder``: none yet."""
        self._folder = folder
        self._rows = False
        self._log = False

    def note(self, error: BaseException, write: Write, opened: OpenMap, rows: int) -> None:
        """A write to a map of ``rows`` rows failed with ``error``; before it appended or was committed that is nothing.

        A COMMIT that found no room wrote no end of the transaction; after any other failure of
        one the log must be emptied first, or a crash could bring that transaction to life.
        """
        found_no_room = isinstance(error, sqlite3.Error) and primary_code(error) == sqlite3.SQLITE_FULL
        self._rows |= write.appending
        self._log |= write.committing and not found_no_room
        try:
            self.repair(opened, rows)
        except (OSError, sqlite3.Error, Damage) as further:
            log.warning("Map %s takes no writes until its files are in order again: %s", self._folder.name, further)

    def repair(self, opened: OpenMap, rows: int) -> None:
        """Bring the files back to the ``rows`` rows acknowledged last; no write is begun until this succeeds.

        Raises:
            OSError, sqlite3.Error: the disk refuses.
            Damage: what was acknowledged is not there.
        """
        if self._log:
            opened.database.settle()
            self._log = False
        if self._rows:
            descriptors.rewind(self._folder, opened.layout, rows)
            # The failed sync may have lost a block that holds the end of the last good row, too.
            with opened.database.reading() as connection:
                named = named_segments(connection, opened.layout)
            if sum(segment.rows for segment in named) != rows:
                raise Damage("map.sqlite names other rows than were acknowledged")
            for last in named[-1:]:
                for _ in descriptors.read_checked(self._folder, opened.layout, last.number, last.rows, last.checksum):
                    pass
            self._rows = False
