"""Reading all of a map again: does the disk still hold what was acknowledged?"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from core.storage import descriptors
from core.storage.caches import StaleCache, cache_name, check_cache
from core.storage.database import FILE, connect
from core.storage.descriptors import Layout
from core.storage.disk import Damage
from core.storage.opening import NamedSegment, living_rows, named_segments, read_layout
from core.storage.records import VerifyReport
from core.storage.schema import check_schema
from core.storage.snapshot import Segment, Snapshot, Spot, vectors

_NAMED = 10  # of the rows of one kind of damage, so many are told one by one


class _Findings:
    def __init__(self) -> None:
        self.problems: list[str] = []
        self.stale_caches: list[str] = []
        self.places = 0
        self.rows = 0
        self.checked_bytes = 0

    @contextmanager
    def noting(self) -> Iterator[None]:
        """A step that cannot be finished is a finding; the next one is taken all the same."""
        try:
            yield
        except (Damage, OSError) as damage:
            self.problems.append(str(damage))
        except (sqlite3.Error, ValueError) as error:
            self.problems.append(f"{FILE}: {error}")

    def report(self) -> VerifyReport:
        return VerifyReport(
            ok=not self.problems,
            places=self.places,
            rows=self.rows,
            checked_bytes=self.checked_bytes,
            problems=self.problems,
            stale_caches=self.stale_caches,
        )


def inspect_folder(folder: Path) -> VerifyReport:
    """Check a map that is out of service."""
    findings = _Findings()
    with findings.noting():
        connection = connect(folder / FILE)
        try:
            check_schema(connection)
            return inspect(folder, connection, None)
        finally:
            connection.close()
    return findings.report()


def inspect(folder: Path, connection: sqlite3.Connection, snapshot: Snapshot | None) -> VerifyReport:
    """Check a map's files against each other, and against ``snapshot`` if it is in service.

    Checked are: SQLite's integrity, every descriptor's checksum, the rows that places name, the
    pictures' digests, the caches; and that what is searched is what is stored.

    Args:
        connection: in a transaction that sees the moment of the snapshot.
    """
    findings = _Findings()
    with findings.noting():
        _check_tables(connection, findings)
    with findings.noting():
        _, layout = read_layout(connection)
        segments = named_segments(connection, layout)
        findings.rows = sum(segment.rows for segment in segments)
        (findings.places,) = connection.execute("SELECT count(*) FROM places").fetchone()
        with findings.noting():
            _check_pictures(connection, findings)
        with findings.noting():
            _check_descriptors(folder, connection, layout, segments, snapshot, findings)
        if snapshot is not None:
            with findings.noting():
                _check_spots(connection, snapshot, findings)
        _check_caches(folder, layout, segments, findings)
    return findings.report()


def _check_tables(connection: sqlite3.Connection, findings: _Findings) -> None:
    for (line,) in connection.execute("PRAGMA integrity_check").fetchall():
        if line != "ok":
            findings.problems.append(f"{FILE}: {line}")
    for table, row, parent, _ in connection.execute("PRAGMA foreign_key_check").fetchall():
        findings.problems.append(f"{FILE}: row {row} of {table} belongs to nothing in {parent}")


def _check_pictures(connection: sqlite3.Connection, findings: _Findings) -> None:
    query = (
        "SELECT p.id, p.number, p.picture, p.digest, k.digest, length(k.bytes) FROM places p"
        " LEFT JOIN pictures k ON k.place = p.number ORDER BY p.number"
    )
    for place, number, kind, source_digest, digest, size in connection.execute(query).fetchall():
        if (kind == "none") != (size is None):
            findings.problems.append(f"{FILE}: place {place!r} is said to keep {kind}, which is not so")
        if size is None:
            continue
        ((content,),) = connection.execute("SELECT bytes FROM pictures WHERE place = ?", (number,)).fetchall()
        findings.checked_bytes += size
        found = hashlib.sha256(content).digest()
        if found != digest or (kind == "image" and found != source_digest):
            findings.problems.append(f"{FILE}: the {kind} of place {place!r} does not match its digest")


def _check_descriptors(
    folder: Path,
    connection: sqlite3.Connection,
    layout: Layout,
    segments: list[NamedSegment],
    snapshot: Snapshot | None,
    findings: _Findings,
) -> None:
    query = "SELECT row, id, checksum FROM places"
    places = {row: (place, checksum) for row, place, checksum in connection.execute(query).fetchall()}
    for row, (place, _) in places.items():
        if row >= findings.rows:
            findings.problems.append(f"{FILE}: place {place!r} has row {row}, but there are {findings.rows}")
    for named in segments:
        with findings.noting():
            _check_segment(folder, layout, named, places, snapshot, findings)


def _check_segment(
    folder: Path,
    layout: Layout,
    named: NamedSegment,
    places: dict[int, tuple[str, int]],
    snapshot: Snapshot | None,
    findings: _Findings,
) -> None:
    row = named.number * layout.rows_per_segment
    damaged: list[int] = []
    foreign: list[int] = []
    differing: list[int] = []
    running = 0
    searched = None if snapshot is None else snapshot.segments[named.number]
    for records in descriptors.read_records(folder, layout, named.number, named.rows):
        damaged += descriptors.damaged_rows(records, row)
        running = descriptors.chain(records["checksum"], running)
        for offset, record in enumerate(records, start=row):
            if offset in places and places[offset][1] != record["checksum"]:
                foreign.append(offset)
            if searched is not None and not _same_descriptors(searched, offset - searched.first_row, record):
                differing.append(offset)
        findings.checked_bytes += records.nbytes
        row += len(records)
    for rows, what in (
        (damaged, "does not match its checksum"),
        (foreign, f"is not the one that {FILE} names"),
        (differing, "is not what is searched"),
    ):
        name = descriptors.segment_name(named.number)
        for found in rows[:_NAMED]:
            whose = f"place {places[found][0]!r}" if found in places else "no place any more"
            findings.problems.append(f"{name}: row {found} ({whose}) {what}")
        if len(rows) > _NAMED:
            findings.problems.append(f"{name}: so with {len(rows) - _NAMED} more rows")
    if not damaged and running != named.checksum:
        findings.problems.append(f"{descriptors.segment_name(named.number)}: its rows are not those that {FILE} names")


def _same_descriptors(segment: Segment, offset: int, record: np.void) -> bool:
    """Byte for byte, for a bit may be flipped that changes no comparison."""
    in_memory = vectors(segment.index)[offset].tobytes(), segment.local[offset].tobytes()
    return in_memory == (record["descriptor"].tobytes(), record["local"].tobytes())


def _same_spot(segment: Segment, offset: int, spot: Spot) -> bool:
    there = segment.whereabouts
    return (
        bool(segment.alive[offset])
        and int(there.kind[offset]) == spot.kind
        and tuple(there.position[offset].tolist()) == spot.position
        and int(there.sequence[offset]) == spot.sequence
        and int(there.ordinal[offset]) == spot.ordinal
    )


def _check_spots(connection: sqlite3.Connection, snapshot: Snapshot, findings: _Findings) -> None:
    """Is what is searched what is stored: the same places, alive, at the same spots?"""
    stored = 0
    for row, _, spot in living_rows(connection, snapshot.rows):
        stored += 1
        segment = snapshot.segments[row // snapshot.rows_per_segment]
        if not _same_spot(segment, row - segment.first_row, spot):
            findings.problems.append(f"row {row} is searched otherwise than {FILE} has it")
    if snapshot.rows != findings.rows or len(snapshot) != stored:
        searched = f"{len(snapshot)} places in {snapshot.rows} rows are searched"
        findings.problems.append(f"{searched}, {stored} in {findings.rows} are stored")


def _check_caches(folder: Path, layout: Layout, segments: list[NamedSegment], findings: _Findings) -> None:
    for named in segments:
        if named.rows == layout.rows_per_segment:
            name = cache_name(named.number)
            try:
                findings.checked_bytes += check_cache(folder / name, layout, named.checksum)
            except StaleCache as stale:
                findings.stale_caches.append(f"{name}: {stale}")
