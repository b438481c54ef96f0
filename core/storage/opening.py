"""Opening a map: from its folder to a snapshot in memory; and making the folder of a new map.

SQLite's records are checked against the segment files, and a map is not served if any part fails its checksum.
"""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.disk.files import TEMPORARY, Damage, primary_code, sync_file, sync_folder
from core.disk.permissions import PRIVATE_FOLDER
from core.disk.sqlite_file import transaction
from core.errors import UnknownMap
from core.index import CodeTable
from core.index.flat import flat_index, vectors
from core.index.table import LARGEST_BLOCK
from core.ledger.maps import places
from core.ledger.maps import record as map_record
from core.ledger.maps.checksums import DamagedRow
from core.ledger.maps.columns import read_columns
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.record import MapState
from core.maps.records import MapRecord, validation_message
from core.maps.status import Tier
from core.places import Whereabouts
from core.storage.database.connections import FILE, Database, connect
from core.storage.database.schema import (
    check_schema,
    connection_of,
    driver_of,
    prepare,
    rebuild_metadata_index,
    wrong_references,
)
from core.storage.database.segments import SegmentEntry, put_rows_per_segment, rows_per_segment, segment_entries
from core.storage.database.write_ahead_log import check_log
from core.storage.files import segment_files as descriptors
from core.storage.files.array_files import StaleArrays
from core.storage.files.row_formats import HALF
from core.storage.files.row_reader import RowReader
from core.storage.files.segment_files import Layout
from core.storage.removed_segments import RemovedSegments, clear_folder
from core.storage.search.index_files import IndexFiles
from core.storage.search.segment import HeldRows, Segment
from core.storage.search.snapshot import Snapshot
from core.storage.search.tiers import holds_for, tier_for

log = logging.getLogger(__name__)

UNLISTED = ".unlisted-"
"""Prefix of the folder of a map that is being built; no map id begins with a dot."""


@contextmanager
def named_damage() -> Iterator[None]:
    """Name the file in which a row is damaged."""
    try:
        yield
    except DamagedRow as damage:
        raise Damage(f"{FILE}: {damage}") from damage


@dataclass(frozen=True, eq=False)
class OpenMap:
    """A map that was read from disk, and the objects to read and write it."""

    state: MapState
    layout: Layout
    database: Database
    row_reader: RowReader
    files: IndexFiles
    removed_segments: RemovedSegments


def create_folder(folder: Path, record: MapRecord, rows: int) -> None:
    """Make ``folder`` with an empty map in it, durable except for the folder's own name.

    Args:
        rows: of a full segment.

    Raises:
        OSError, sqlite3.Error: the disk refuses.
    """
    folder.mkdir(PRIVATE_FOLDER)
    connection = connect(folder / FILE, create=True)
    try:
        prepare(connection, create=True)
        with transaction(connection):
            made = connection_of(connection)
            map_record.create(made.whole, record)
            put_rows_per_segment(made, rows)
    finally:
        connection.close()  # SQLite moves its log into the file and deletes it
    sync_file(folder / FILE)
    sync_folder(folder)


def read_layout(connection: MapConnection, map_id: str = "") -> tuple[MapState, Layout]:
    """The state of a map and the layout of its segment files.

    Raises:
        Damage: the record is invalid, or missing.
    """
    try:
        state = map_record.state_of(connection, map_id)
        record = state.record
        layout = Layout(
            record.dimension, record.encoder, rows_per_segment(connection), record.local_shape, record.precision
        )
        return state, layout
    except (ValueError, UnknownMap) as error:
        raise DamagedRow(f"the map's own record cannot be read: {error}") from error


def _adopt(folder: Path, connection: MapConnection) -> tuple[MapState, Layout]:
    state, layout = read_layout(connection, folder.name)
    if state.record.id != folder.name.removeprefix(UNLISTED):
        raise Damage(f"{FILE}: it belongs to the map {state.record.id!r}")
    return state, layout


def _check_files(folder: Path) -> None:
    if not (folder / FILE).is_file():
        folder.stat()  # a folder that cannot be reached is no damage: its disk may come back
        raise Damage(f"{FILE} is missing")
    check_log(folder / f"{FILE}-wal")


def read_record(folder: Path) -> tuple[MapRecord, int]:
    """The record of a map and how many places it has, without its places.

    Raises:
        DataDirectoryTooNew, DataDirectoryTooOld: its database is of a version that is not read.
        Damage: it is not a map, or another one than its folder says.
        sqlite3.Error: it cannot be read.
    """
    _check_files(folder)
    connection = connect(folder / FILE)
    try:
        prepare(connection, str(folder / FILE))
        check_schema(connection)
        with named_damage():
            state, _ = _adopt(folder, connection_of(connection))
        return state.record, state.places
    except sqlite3.OperationalError as error:
        if primary_code(error) == sqlite3.SQLITE_ERROR:  # our statements do not fit its tables
            raise Damage(f"{FILE}: {error}") from error
        raise
    finally:
        connection.close()


def _load_segment(folder: Path, layout: Layout, entry: SegmentEntry, checksums: NDArray[np.uint32]) -> HeldRows:
    """The descriptors of a segment, each of them checked; ``checksums`` are those that SQLite has of its rows."""
    index = flat_index(entry.rows, layout.dimension, layout.precision == HALF)
    local = np.zeros((entry.rows, *layout.local_shape), dtype=np.int8)
    target, filled, first = vectors(index), 0, entry.number * layout.rows_per_segment
    for records in descriptors.read_checked(folder, layout, entry.number, entry.rows, entry.checksum):
        part = slice(filled, filled + len(records))
        foreign = (checksums[part] != 0) & (checksums[part] != records["checksum"])
        for offset in np.flatnonzero(foreign)[:1].tolist():
            row = int(records["row"][offset])
            raise Damage(f"{descriptors.segment_name(entry.number)}: row {row} is of another frame")
        if found := [row for row in descriptors.erased_rows(records, first + filled) if checksums[row - first]]:
            raise Damage(f"{descriptors.segment_name(entry.number)}: row {found[0]} has a place and is erased")
        target[part], local[part] = layout.descriptors_of(records), layout.locals_of(records)
        filled += len(records)
    return HeldRows(index, local)


def _load_codes(files: IndexFiles, entries: Sequence[SegmentEntry]) -> CodeTable:
    """The codes of the first groups of segments that have good files."""
    table, group = CodeTable.empty(files.coder), 0
    read = [files.coder.blank(0)]  # for one block, so that not all codes are in memory twice
    with suppress(StaleArrays):
        while of_group := files.group_entries(entries, group):
            read.append(files.read_codes(of_group))
            group += 1
            if sum(len(codes) for codes in read) >= LARGEST_BLOCK:
                table, read = table.appended(np.concatenate(read)), read[:1]
    return table.appended(np.concatenate(read))


def _check_rows(folder: Path, connection: MapConnection) -> None:
    """Check all rows of a small map and their indexes; pictures are checked when they are read."""
    for table in ("places", "tokens", "sequences"):
        ((line,),) = driver_of(connection).execute(f"PRAGMA integrity_check({table})").fetchmany(1)
        if line != "ok":
            raise Damage(f"{FILE}: {line}")
    if broken := places.unsound(connection):
        raise Damage(f"{FILE}: place {broken[0]!r} does not match its checksum")
    if found := wrong_references(connection):
        raise Damage(f"{FILE}: {found[0]}")
    if found := places.stale_tokens(connection):  # it can be made again from the places, which are sound
        log.warning("The index of the metadata of map %s is rebuilt: %s.", folder.name, found[0])
        rebuild_metadata_index(connection)


def read_snapshot(
    folder: Path,
    layout: Layout,
    connection: MapConnection,
    state: MapState,
    row_reader: RowReader,
    files: IndexFiles,
) -> Snapshot:
    """The snapshot of a map, read from disk.

    The descriptors of a small map are read and checked.  Those of a larger map stay on disk and are checked when they
    are read; here it is only checked that their files are there, belong to this map, and are long enough.

    Raises:
        Damage: SQLite and the segment files do not agree, or a checksum fails.
        OSError, sqlite3.Error: the disk refuses.
    """
    entries = segment_entries(connection, layout)
    total, record = sum(segment.rows for segment in entries), state.record
    columns = read_columns(connection, total)
    if (state.rows, state.searched) != (total, len(columns.rows)):
        counted = f"{state.searched} places and looks in {state.rows} rows"
        raise Damage(f"{FILE}: its record counts {counted}, but there are {len(columns.rows)} in {total}")
    whereabouts = columns.by_row(total)
    alive, checksums = np.zeros(total, np.bool_), np.zeros(total, np.uint32)
    alive[columns.rows], checksums[columns.rows] = True, columns.checksums
    # The index that a map had before is not known, but the number of its places allows it to be as it was.
    table = _load_codes(files, entries)
    present: Tier = "compact" if len(table) else "exact"
    tier = tier_for(record.index, len(columns.rows), present)
    holds = holds_for(record.index, len(columns.rows), True)
    segments = []
    for segment in entries:
        first = segment.number * layout.rows_per_segment
        part = slice(first, first + segment.rows)
        there = Whereabouts(**{name: column[part] for name, column in vars(whereabouts).items()})
        if segment.removed:
            if alive[part].any():
                raise Damage(f"{FILE}: segment {segment.number + 1} is recorded as removed, but has places")
            segments.append(Segment(None, first, there, alive[part], checksums[part], removed=True))
            continue
        if not holds:
            row_reader.check(segment.number, segment.rows)
        held = _load_segment(folder, layout, segment, checksums[part]) if holds else None
        segments.append(Segment(held, first, there, alive[part], checksums[part]))
    if holds:
        _check_rows(folder, connection)
    return Snapshot(
        layout.dimension,
        layout.rows_per_segment,
        tuple(segments),
        layout.local_shape,
        row_reader,
        table if tier == "compact" else None,
        holds,
        layout.precision == HALF,
    )


def open_map(folder: Path) -> tuple[OpenMap, Snapshot]:
    """Open a map for use, and delete the unfinished work of a crash.

    The snapshot is returned apart from the rest, so that its memory can be freed when a later one takes its place.

    Raises:
        DataDirectoryTooNew, DataDirectoryTooOld: its database is of a version that is not read.
        Damage: the content on disk is not the one that was written.
        OSError, sqlite3.Error: the disk refuses.
    """
    _check_files(folder)
    database = Database(folder / FILE)
    try:
        with named_damage(), database.reading() as connection:
            state, layout = _adopt(folder, connection)
            row_reader, files = RowReader(folder, layout), IndexFiles(folder, layout)
            snapshot = read_snapshot(folder, layout, connection, state, row_reader, files)
            clear_folder(folder, segment_entries(connection, layout))
        descriptors.rewind(folder, layout, snapshot.rows)
        sync_folder(folder)  # the name of SQLite's log
        for superfluous in folder.glob(f"*{TEMPORARY}"):
            superfluous.unlink()
    except sqlite3.OperationalError as error:
        database.close()
        if primary_code(error) == sqlite3.SQLITE_ERROR:  # our statements do not fit its tables
            raise Damage(f"map.sqlite: {error}") from error
        raise
    except ValueError as error:
        database.close()
        raise Damage(f"map.sqlite: {validation_message(error)}") from error
    except TypeError as error:  # NULL where the tables allow none
        database.close()
        raise Damage(f"{FILE}: a value is invalid: {error}") from error
    except BaseException:
        database.close()
        raise
    return OpenMap(state, layout, database, row_reader, files, RemovedSegments(folder, layout)), snapshot
