"""From a map's folder to a map in memory, and the folder of a new map.

What SQLite names is checked against the segment files; nothing that fails a checksum is served.
"""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from core.places import Pose
from core.storage import descriptors, ledger
from core.storage.caches import StaleCache, cache_name, load_cache, write_cache
from core.storage.database import FILE, Database, connect
from core.storage.descriptors import Layout, Local
from core.storage.disk import TEMPORARY, Damage, primary_code, sync_file, sync_folder
from core.storage.patches import complaint
from core.storage.records import MapRecord
from core.storage.schema import NO_SEQUENCE, check_schema, migrate
from core.storage.snapshot import Segment, Snapshot, Spot, flat_index, vectors, whereabouts_of
from core.verdict import GEOGRAPHIC, METRIC, NO_POSE

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class NamedSegment:
    """What SQLite says of a segment file."""

    number: int
    rows: int
    checksum: int


@dataclass(frozen=True, eq=False)
class OpenMap:
    """A map in memory."""

    record: MapRecord
    layout: Layout
    database: Database
    snapshot: Snapshot


def spot_of(pose: Pose | None, sequence: int, ordinal: int) -> Spot:
    """A place as the snapshot knows it."""
    if pose is None:
        return Spot(NO_POSE, (0.0, 0.0, 0.0), sequence, ordinal)
    x, y, z = pose.position().tolist()
    return Spot(METRIC if pose.kind() == "metric" else GEOGRAPHIC, (x, y, z), sequence, ordinal)


def create_folder(folder: Path, record: MapRecord, rows_per_segment: int) -> None:
    """Make ``folder`` and in it an empty map, synced except for the folder's own name.

    Raises:
        OSError, sqlite3.Error: the disk refuses.
    """
    folder.mkdir()
    connection = connect(folder / FILE, create=True)
    try:
        migrate(connection, create=True)
        connection.execute("BEGIN IMMEDIATE")
        ledger.insert_record(connection, record, rows_per_segment)
        connection.execute("COMMIT")
    finally:
        connection.close()  # the log goes into the file and is removed
    sync_file(folder / FILE)
    sync_folder(folder)


def read_layout(connection: sqlite3.Connection) -> tuple[MapRecord, Layout]:
    """The map's record and what its segment files have in common.

    Raises:
        Damage: the record makes no sense.
    """
    try:
        record, rows_per_segment = ledger.read_record(connection)
        return record, Layout(record.dimension, record.encoder, rows_per_segment, record.local_shape)
    except ValueError as error:
        raise Damage(f"map.sqlite: the map's own record cannot be read: {complaint(error)}") from error


def _adopt(folder: Path, connection: sqlite3.Connection) -> tuple[MapRecord, Layout]:
    record, layout = read_layout(connection)
    if record.id != folder.name:
        raise Damage(f"the folder holds the map {record.id!r}")
    return record, layout


def read_record(folder: Path) -> tuple[MapRecord, int]:
    """The record of a map that is not opened yet, and how many places it has; an older file is migrated.

    Raises:
        DataDirectoryTooNew: a later version wrote it.
        Damage: it is not a map, or not the one its folder names.
        sqlite3.Error: it cannot be read.
    """
    if not (folder / FILE).is_file():
        raise Damage(f"{FILE} is missing")
    connection = connect(folder / FILE)
    try:
        migrate(connection)
        check_schema(connection)
        (places,) = connection.execute("SELECT count(*) FROM places").fetchone()
        return _adopt(folder, connection)[0], int(places)
    finally:
        connection.close()


def named_segments(connection: sqlite3.Connection, layout: Layout) -> list[NamedSegment]:
    """The segments in order.

    Raises:
        Damage: one is missing, or one that is not the last is not full.
    """
    found = [NamedSegment(*row) for row in connection.execute("SELECT * FROM segments ORDER BY number").fetchall()]
    for position, segment in enumerate(found):
        full, last = segment.rows == layout.rows_per_segment, position == len(found) - 1
        if segment.number != position or segment.rows > layout.rows_per_segment or not (full or last):
            raise Damage(f"map.sqlite: segment {position + 1} is not as long as it must be")
    return found


def living_rows(connection: sqlite3.Connection, rows: int) -> Iterator[tuple[int, int, Spot]]:
    """Row, checksum and spot of every place.

    Raises:
        Damage: a place has a row that no segment has.
    """
    query = "SELECT row, checksum, sequence, ordinal, x, y, z, latitude, longitude FROM places"
    for row, checksum, sequence, ordinal, *coordinates in connection.execute(query).fetchall():
        if row >= rows:
            raise Damage(f"map.sqlite: a place has row {row}, but there are {rows}")
        named = dict(zip(("x", "y", "z", "latitude", "longitude"), coordinates, strict=True))
        pose = Pose(**named) if any(value is not None for value in coordinates) else None
        yield row, checksum, spot_of(pose, sequence, ordinal)


def _load_segment(folder: Path, layout: Layout, named: NamedSegment, wanted: dict[int, int]) -> tuple[Any, Local]:
    """Index and local descriptors of a segment: from its cache if it has a good one, else from the records."""
    full = named.rows == layout.rows_per_segment
    cache = folder / cache_name(named.number)
    if full:
        try:
            return load_cache(cache, layout, named.checksum)
        except StaleCache as stale:
            log.warning("Map %s: %s is made again from the descriptors: %s.", folder.name, cache.name, stale)
    index = flat_index(named.rows, layout.dimension)
    local = np.zeros((named.rows, *layout.local_shape), dtype=np.int8)
    target, filled = vectors(index), 0
    for records in descriptors.read_checked(folder, layout, named.number, named.rows, named.checksum):
        for record in records:
            if wanted.get(int(record["row"]), int(record["checksum"])) != record["checksum"]:
                raise Damage(f"{descriptors.segment_name(named.number)}: row {record['row']} is of another frame")
        target[filled : filled + len(records)] = records["descriptor"]
        local[filled : filled + len(records)] = records["local"]
        filled += len(records)
    if full:
        write_cache(cache, index, local, named.checksum)
    return index, local


def read_snapshot(folder: Path, layout: Layout, connection: sqlite3.Connection) -> Snapshot:
    """All that is searched, from disk.

    Raises:
        Damage: SQLite and the segment files do not agree, or a checksum fails.
        OSError, sqlite3.Error: the disk refuses.
    """
    named = named_segments(connection, layout)
    total = sum(segment.rows for segment in named)
    spots = [Spot(NO_POSE, (0.0, 0.0, 0.0), NO_SEQUENCE, 0)] * total
    alive = np.zeros(total, dtype=np.bool_)
    wanted: dict[int, int] = {}
    for row, checksum, spot in living_rows(connection, total):
        spots[row], alive[row], wanted[row] = spot, True, checksum
    segments = []
    for segment in named:
        first = segment.number * layout.rows_per_segment
        part = slice(first, first + segment.rows)
        index, local = _load_segment(folder, layout, segment, wanted)
        segments.append(Segment(index, local, first, whereabouts_of(spots[part]), alive[part].copy()))
    return Snapshot(layout.dimension, layout.rows_per_segment, tuple(segments), layout.local_shape)


def open_map(folder: Path) -> OpenMap:
    """Open a map for use, and clear away what a crash left unfinished.

    Raises:
        DataDirectoryTooNew: a later version wrote it.
        Damage: what is on disk is not what was written.
        OSError, sqlite3.Error: the disk refuses.
    """
    if not (folder / FILE).is_file():
        raise Damage(f"{FILE} is missing")
    database = Database(folder / FILE)
    try:
        with database.reading() as connection:
            record, layout = _adopt(folder, connection)
            snapshot = read_snapshot(folder, layout, connection)
        descriptors.rewind(folder, layout, snapshot.rows)
        sync_folder(folder)  # SQLite has made the name of its log
        for unfinished in folder.glob(f"*{TEMPORARY}"):
            unfinished.unlink()
    except sqlite3.OperationalError as error:
        database.close()
        if primary_code(error) == sqlite3.SQLITE_ERROR:  # SQL that suits our tables does not suit these
            raise Damage(f"map.sqlite: {error}") from error
        raise
    except ValueError as error:
        database.close()
        raise Damage(f"map.sqlite: {complaint(error)}") from error
    except BaseException:
        database.close()
        raise
    return OpenMap(record, layout, database, snapshot)
