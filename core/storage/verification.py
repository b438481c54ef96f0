"""Reading all files of a map again to see whether the disk still holds the written data."""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.disk.files import Damage
from core.index.flat import vectors
from core.ledger.maps import cameras, frames, places
from core.ledger.maps.checksums import DamagedRow
from core.ledger.maps.columns import read_columns
from core.ledger.maps.connection import MapConnection
from core.maps.records import VerifyReport
from core.maps.status import Progress, no_progress
from core.storage.database.connections import FILE, connect, connect_without_log
from core.storage.database.schema import check_schema, connection_of, contradictions, driver_of
from core.storage.database.segments import SegmentEntry, segment_entries
from core.storage.database.write_ahead_log import check_log
from core.storage.files import segment_files as descriptors
from core.storage.files.segment_files import Layout
from core.storage.opening import UNLISTED, read_layout
from core.storage.review import FILE as REVIEW_FILE
from core.storage.review import ReviewFrames
from core.storage.search.index_files import IndexFiles
from core.storage.search.segment import Segment
from core.storage.search.snapshot import Snapshot

_MOST_LISTED = 10  # damaged rows of one kind that are listed one by one; further ones are counted


class _Findings:
    def __init__(self, progress: Progress = no_progress) -> None:
        self.progress = progress
        self.problems: list[str] = []
        self.stale_caches: list[str] = []
        self.places = 0
        self.rows = 0
        self.checked_bytes = 0

    @contextmanager
    def noting(self) -> Iterator[None]:
        """Note an error that ends the block as a problem, and go on after it."""
        try:
            yield
        except DamagedRow as damage:
            self.problems.append(f"{FILE}: {damage}")
        except (Damage, OSError) as damage:
            self.problems.append(str(damage))
        except (sqlite3.Error, ValueError, TypeError) as error:
            self.problems.append(f"{FILE}: {error}")

    def list_some(self, problems: list[str], kind: str) -> None:
        """Note some problems of one kind one by one, and the number of the others."""
        self.problems += problems[:_MOST_LISTED]
        if len(problems) > _MOST_LISTED:
            self.problems.append(f"{FILE}: the same is true of {len(problems) - _MOST_LISTED} more {kind}")

    def report(self) -> VerifyReport:
        return VerifyReport(
            ok=not self.problems,
            places=self.places,
            rows=self.rows,
            checked_bytes=self.checked_bytes,
            problems=self.problems,
            stale_caches=self.stale_caches,
        )


def inspect_folder(folder: Path, progress: Progress = no_progress) -> VerifyReport:
    """Check a map that is out of service; a damaged log is reported, ignored and left as it is."""
    findings = _Findings(progress)
    is_log_sound = False
    with findings.noting():
        check_log(folder / f"{FILE}-wal")
        is_log_sound = True
    with findings.noting():
        # SQLite would move what it can read of a damaged log into the file, and delete the rest with the log.
        connection = connect(folder / FILE) if is_log_sound else connect_without_log(folder / FILE)
        try:
            check_schema(connection)
            map_id = folder.name.removeprefix(UNLISTED)
            review = ReviewFrames(folder / REVIEW_FILE, map_id, lambda: None)
            report = inspect(folder, connection_of(connection), None, review, progress)
            return report.model_copy(
                update={"ok": report.ok and not findings.problems, "problems": findings.problems + report.problems}
            )
        finally:
            connection.close()
    return findings.report()


def inspect(
    folder: Path,
    connection: MapConnection,
    snapshot: Snapshot | None,
    review: ReviewFrames,
    progress: Progress = no_progress,
) -> VerifyReport:
    """Check a map's files against each other and, if the map is in service, against its snapshot.

    This checks SQLite's integrity, the checksums of rows, descriptors and keypoints, the rows that places refer to, the
    digests of pictures, the frames for review and the index files, and that the snapshot is what is stored.

    Args:
        connection: in a transaction of the moment of the snapshot.  The transaction is ended before descriptors are
            read, which takes long, because SQLite cannot empty its log while it lasts.
        snapshot: also keeps the files of its descriptors from being deleted; None for a map that is out of service.
        review: the frames that the map stores for review.
        progress: is called while descriptors are read.
    """
    findings = _Findings(progress)
    with findings.noting():
        _check_tables(connection, findings)
    with findings.noting():
        _check_row_checksums(connection, findings)
    with findings.noting():
        findings.problems += [f"{FILE}: {found}" for found in contradictions(connection)]
    with findings.noting():
        state, layout = read_layout(connection, folder.name)
        segments = segment_entries(connection, layout)
        findings.rows = sum(segment.rows for segment in segments)
        findings.places, looks = places.count(connection)
        if (state.places, state.looks, state.rows) != (findings.places, looks, findings.rows):
            counted = f"{state.places} places and {state.looks} looks in {state.rows} rows"
            found = f"{findings.places} and {looks} in {findings.rows}"
            findings.problems.append(f"{FILE}: its record counts {counted}, but there are {found}")
        with findings.noting():
            _check_pictures(connection, findings)
        with findings.noting():
            _check_keypoints(connection, findings)
        if snapshot is not None:
            with findings.noting():
                _check_locations(connection, snapshot, findings)
        known = {row: (place, checksum) for row, place, checksum in places.checksums(connection)}
        if (driver := driver_of(connection)).in_transaction:
            driver.execute("ROLLBACK")
        with findings.noting():
            _check_descriptors(folder, layout, known, segments, snapshot, findings)
        if snapshot is not None:
            checked, stale = IndexFiles(folder, layout).check(segments) if snapshot.table is not None else (0, [])
            findings.checked_bytes += checked
            findings.stale_caches += stale
    problems, size = review.check()
    findings.problems += problems
    findings.checked_bytes += size
    return findings.report()


def _check_tables(connection: MapConnection, findings: _Findings) -> None:
    for (line,) in driver_of(connection).execute("PRAGMA integrity_check").fetchall():
        if line != "ok":
            findings.problems.append(f"{FILE}: {line}")


def _check_row_checksums(connection: MapConnection, findings: _Findings) -> None:
    for kind, names in (("place", places.unsound(connection)), ("camera", cameras.unsound(connection))):
        findings.list_some([f"{FILE}: {kind} {name!r} does not match its checksum" for name in names], f"{kind}s")


def _check_pictures(connection: MapConnection, findings: _Findings) -> None:
    """Check all pictures, one after another."""
    for place, row, kind, source_digest, camera in places.pictured(connection):
        found = frames.stored_pictures_at(connection, [row]).get(row)
        if (kind == "none") != (found is None):
            findings.problems.append(f"{FILE}: place {place!r} is recorded to keep {kind}, which is not true")
        if found is None:
            continue
        content, digest = found
        findings.checked_bytes += len(content)
        computed = hashlib.sha256(content).digest()
        # The digest of a place with a camera covers its image and the camera's mask.
        if computed != digest or (kind == "image" and camera is None and computed != source_digest):
            findings.problems.append(f"{FILE}: the {kind} of place {place!r} does not match its digest")
    if rows := frames.rows_of_no_place(connection):
        findings.problems.append(f"{FILE}: the pictures or keypoints of {len(rows)} rows belong to no place")


def _check_keypoints(connection: MapConnection, findings: _Findings) -> None:
    findings.checked_bytes += frames.room(connection)[1]
    names = frames.damaged_keypoints(connection)
    problems = [f"{FILE}: the keypoints of place {place!r} do not match their checksum" for place in names]
    findings.list_some(problems, "places")


def _check_descriptors(
    folder: Path,
    layout: Layout,
    places: dict[int, tuple[str, int]],
    segments: list[SegmentEntry],
    snapshot: Snapshot | None,
    findings: _Findings,
) -> None:
    for row, (place, _) in places.items():
        if row >= findings.rows:
            findings.problems.append(f"{FILE}: place {place!r} has row {row}, but there are {findings.rows}")
    for entry in segments:
        findings.progress(entry.number * layout.rows_per_segment, findings.rows)
        with findings.noting():
            _check_segment(folder, layout, entry, places, snapshot, findings)


def _check_segment(
    folder: Path,
    layout: Layout,
    entry: SegmentEntry,
    places: dict[int, tuple[str, int]],
    snapshot: Snapshot | None,
    findings: _Findings,
) -> None:
    row = entry.number * layout.rows_per_segment
    if entry.removed:
        for place in [places[one][0] for one in range(row, row + entry.rows) if one in places][:_MOST_LISTED]:
            findings.problems.append(f"{FILE}: the segment of place {place!r} is recorded as removed")
        return
    damaged: list[int] = []
    foreign: list[int] = []
    differing: list[int] = []
    running = 0
    searched = None if snapshot is None else snapshot.segments[entry.number]
    for records in descriptors.read_records(folder, layout, entry.number, entry.rows):
        damaged += descriptors.damaged_rows(layout, records, row)
        damaged += [one for one in descriptors.erased_rows(records, row) if one in places]
        running = descriptors.segment_checksum(records["checksum"], running)
        expected_sums = [places[offset][1] if offset in places else None for offset in range(row, row + len(records))]
        for offset, (expected_sum, record) in enumerate(zip(expected_sums, records, strict=True), start=row):
            if expected_sum not in (None, record["checksum"]):
                foreign.append(offset)
        if searched is not None:
            differing += [row + offset for offset in _differing(searched, row - searched.first_row, layout, records)]
        findings.checked_bytes += records.nbytes
        row += len(records)
        findings.progress(row, findings.rows)
    for rows, what in (
        (damaged, "does not match its checksum"),
        (foreign, f"is not the one that {FILE} records"),
        (differing, "is not what is searched"),
    ):
        name = descriptors.segment_name(entry.number)
        for found in rows[:_MOST_LISTED]:
            whose = f"place {places[found][0]!r}" if found in places else "of no place"
            findings.problems.append(f"{name}: row {found} ({whose}) {what}")
        if len(rows) > _MOST_LISTED:
            findings.problems.append(f"{name}: the same is true of {len(rows) - _MOST_LISTED} more rows")
    if not damaged and running != entry.checksum:
        findings.problems.append(f"{descriptors.segment_name(entry.number)}: its rows are not those in {FILE}")


def _differing(segment: Segment, start: int, layout: Layout, records: NDArray[np.void]) -> list[int]:
    """Which of the rows from ``start`` on differ between memory and disk.

    Rows are compared byte for byte, because a flipped bit need not change a comparison of numbers.  Of a segment whose
    descriptors stay on disk the checksums in memory are compared: whatever is read of it must match them.
    """
    rows = slice(start, start + len(records))
    if segment.held is None:
        expected = segment.checksums[rows]
        return [int(offset) for offset in np.flatnonzero((expected != 0) & (expected != records["checksum"]))]
    stored = zip(layout.descriptors_of(records), layout.locals_of(records), strict=True)
    held = zip(vectors(segment.index)[rows].astype(np.float32, copy=False), segment.local[rows], strict=True)
    return [
        offset
        for offset, (there, here) in enumerate(zip(stored, held, strict=True))
        if segment.alive[start + offset] and [part.tobytes() for part in there] != [part.tobytes() for part in here]
    ]


def _check_locations(connection: MapConnection, snapshot: Snapshot, findings: _Findings) -> None:
    """Check that the snapshot has the places that are stored, at the same locations."""
    columns = read_columns(connection, snapshot.rows)
    searched, stored = snapshot.whereabouts.take(columns.rows), columns.whereabouts
    same = snapshot.alive[columns.rows]
    for name, column in vars(stored).items():
        found = getattr(searched, name)
        if name == "position":  # the computation of a point on the sphere may differ in its last bits
            same &= np.isclose(found, column, rtol=0, atol=1e-6).all(axis=1)
        else:
            same &= (found == column) | ((found != found) & (column != column))
    for row in columns.rows[~same].tolist():
        findings.problems.append(f"row {row} differs between what is searched and {FILE}")
    if snapshot.rows != findings.rows or len(snapshot) != len(columns.rows):
        searched_now = f"{len(snapshot)} places in {snapshot.rows} rows are searched"
        findings.problems.append(f"{searched_now}, {len(columns.rows)} in {findings.rows} are stored")
