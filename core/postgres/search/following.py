"""The snapshot of a map in the memory of a service, brought up to date before each query.

Every write to a map makes a revision of it, under the lock of the map's row, so that revisions are in the order of
commits; it draws a stamp at random and stores it with the revision.  A service reads, in the transaction in which it
reads the revision, which places changed and which rows died since the one that it holds.  If the stamp of that one is
not stored any more, or is another one, the database was restored or another server took over that lacks some writes:
then the service forgets all that it has of the map, its cached rows included, and reads it anew.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.errors import StorageFailure
from core.index import Coder, Codes, CodeTable
from core.index.flat import flat_index, vectors
from core.ledger.maps.columns import read_columns
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.record import MapState
from core.ledger.postgres import PostgresConnection, PostgresLedger
from core.maps.records import MapRecord
from core.maps.status import Tier
from core.places import NO_POSE, NO_SEQUENCE, Whereabouts
from core.postgres import rows
from core.postgres.forms import Form
from core.postgres.search.cache import RowCache
from core.postgres.search.row_source import PostgresRows
from core.storage.files.row_formats import HALF
from core.storage.files.segment_files import ROWS_PER_SEGMENT
from core.storage.search.segment import HeldRows, Location, Segment
from core.storage.search.snapshot import Snapshot
from core.storage.search.tiers import tier_for

log = logging.getLogger(__name__)

CODES_AT_ONCE = 4096
"""Codes that are read at a time."""

DESCRIPTORS_AT_ONCE = 256
"""Descriptors that are read at a time."""

_NOWHERE = Location(NO_POSE, (0.0, 0.0, 0.0), NO_SEQUENCE, 0)


@dataclass(frozen=True, eq=False)
class Followed:
    """A snapshot, and the revision and the stamp of the map that it shows."""

    snapshot: Snapshot
    revision: int
    stamp: str
    source: PostgresRows


class FollowedMap:
    """The snapshot of one map.  Any thread may use it.

    Args:
        database, cache: of the service.
        map_number: of the map.
    """

    def __init__(self, database: PostgresLedger, cache: RowCache, map_number: int) -> None:
        self._database, self._cache, self._map = database, cache, map_number
        self._lock = threading.RLock()
        self._joining = threading.Lock()
        self._held: Followed | None = None

    @property
    def held(self) -> Followed | None:
        """The state in memory; None before the first use."""
        return self._held

    def as_of(self, state: MapState) -> Followed | None:
        """The snapshot that is held, if it shows this state; else None."""
        held = self._held
        return held if held is not None and (held.revision, held.stamp) == (state.revision, state.stamp) else None

    def up_to_date(self, connection: MapConnection, state: MapState) -> Followed:
        """The snapshot of a state of the map that was read in this transaction."""
        if (held := self.as_of(state)) is None:
            with self._lock:
                held = self.as_of(state) or self._advanced(connection, state)
        return held

    def _advanced(self, connection: MapConnection, state: MapState) -> Followed:
        held = self._held
        if held is not None and held.revision > state.revision:
            # This transaction does not see so much; and others that wait here may hold all connections of the pool.
            with self._database.alone("read") as fresh:
                if self._follows(MapConnection(PostgresConnection(fresh), self._map), held):
                    return held  # another thread has seen more
            held = None
        if held is None or not self._follows(connection, held) or self._tier(state, held) != tier_of(held.snapshot):
            source = PostgresRows(self._database, self._map, state.record, self._cache)
            snapshot = self._read(connection, state, source)
        else:
            source, snapshot = held.source, self._with_changes(connection, state, held)
        self._held = Followed(snapshot, state.revision, state.stamp, source)
        if snapshot.table is not None and snapshot.table.is_loose:
            threading.Thread(target=self._join, name="index", daemon=True).start()
        return self._held

    def _follows(self, connection: MapConnection, held: Followed) -> bool:
        """Whether what is held is a revision that the database has."""
        if not held.revision:
            return not held.stamp
        known = rows.stamp_of(connection, held.revision)
        if known != held.stamp:
            log.warning("Map %d is read anew: its revision %d is not that of the database", self._map, held.revision)
        return known == held.stamp

    def _tier(self, state: MapState, held: Followed | None) -> Tier:
        present: Tier = "exact" if held is None else tier_of(held.snapshot)
        return tier_for(state.record.index, state.searched, present)

    # Reading all

    def _read(self, connection: MapConnection, state: MapState, source: PostgresRows) -> Snapshot:
        columns, total = read_columns(connection, state.rows), state.rows
        if len(columns.rows) != state.searched:
            counted = f"its record counts {state.searched}"
            raise StorageFailure(f"The map has {len(columns.rows)} places and looks, but {counted}.")
        whereabouts = columns.by_row(total)
        alive = np.zeros(total, np.bool_)
        alive[columns.rows] = True
        record, exact = state.record, self._tier(state, None) == "exact"
        segments = []
        for first in range(0, total, ROWS_PER_SEGMENT):
            part = slice(first, min(total, first + ROWS_PER_SEGMENT))
            there = Whereabouts(**{name: column[part] for name, column in vars(whereabouts).items()})
            held = self._held_rows(connection, record, first, alive[part]) if exact else None
            segments.append(Segment(held, first, there, alive[part], np.zeros(len(there), np.uint32)))
        table = None if exact else self._table(connection, record, total)
        return Snapshot(
            record.dimension, ROWS_PER_SEGMENT, tuple(segments), record.local_shape, source, table, exact,
            record.precision == HALF,
        )  # fmt: skip

    def _held_rows(
        self, connection: MapConnection, record: MapRecord, first: int, alive: NDArray[np.bool_]
    ) -> HeldRows:
        index = flat_index(len(alive), record.dimension, record.precision == HALF)
        local = np.zeros((len(alive), *record.local_shape), np.int8)
        for offsets, descriptors, cells in _both(connection, record, first, np.flatnonzero(alive)):
            vectors(index)[offsets], local[offsets] = descriptors, cells
        return HeldRows(index, local)

    def _table(self, connection: MapConnection, record: MapRecord, total: int) -> CodeTable:
        coder = Coder.of(record.dimension)
        made, missing = coder.blank(total), list[int]()
        for page in rows.all_codes(connection, CODES_AT_ONCE):
            for row, code in page:
                if row >= total:
                    continue
                if code is None:
                    missing.append(row)
                else:
                    made[row] = np.frombuffer(code, np.uint8)
        self._encode(connection, record, coder, made, missing, 0)
        return CodeTable.empty(coder).appended(made)

    def _encode(
        self,
        connection: MapConnection,
        record: MapRecord,
        coder: Coder,
        codes: Codes,
        missing: list[int],
        first: int,
    ) -> None:
        """Compute codes that are not stored."""
        form = Form(record)
        for start in range(0, len(missing), DESCRIPTORS_AT_ONCE):
            some = missing[start : start + DESCRIPTORS_AT_ONCE]
            stored = rows.descriptors_at(connection, some)
            there = [row for row in some if row in stored]
            if there:
                found = coder.encode(form.descriptors([stored[row] for row in there]))
                codes[[row - first for row in there]] = found

    # Reading changes

    def _with_changes(self, connection: MapConnection, state: MapState, held: Followed) -> Snapshot:
        last, record = held.snapshot, state.record
        columns = read_columns(connection, state.rows, held.revision)
        locations = dict(zip(columns.rows.tolist(), _locations(columns.whereabouts), strict=True))
        after = last
        if count := state.rows - last.rows:
            new = range(last.rows, state.rows)
            after = self._appended(connection, record, last, [locations.get(row, _NOWHERE) for row in new])
            gone = [row for row in new if row not in locations]
            after = after.without(gone) if gone else after
            assert after.rows == last.rows + count
        if moved := {row: location for row, location in locations.items() if row < last.rows}:
            after = after.moved(moved)
        if dead := [row for row in rows.dead_since(connection, held.revision) if row < last.rows]:
            after = after.without(dead)
        if len(after) != state.searched:
            raise StorageFailure(f"The map has {state.searched} places and looks, but {len(after)} were found.")
        return after

    def _appended(
        self, connection: MapConnection, record: MapRecord, last: Snapshot, locations: list[Location]
    ) -> Snapshot:
        first, count = last.rows, len(locations)
        new = list(range(first, first + count))
        local = np.zeros((count, *(record.local_shape if last.holds else (0, 0))), np.int8)
        if last.table is not None:
            codes = last.table.coder.blank(count)
            missing = []
            for row, code in rows.codes_at(connection, new).items():
                if code is None:
                    missing.append(row)
                else:
                    codes[row - first] = np.frombuffer(code, np.uint8)
            self._encode(connection, record, last.table.coder, codes, missing, first)
            return last.appended(np.empty((count, 0), np.float32), locations, local, codes=codes)
        descriptors = np.zeros((count, record.dimension), np.float16 if last.halves else np.float32)
        for offsets, found, cells in _both(connection, record, first, np.arange(count)):
            descriptors[offsets], local[offsets] = found, cells
        return last.appended(descriptors, locations, local)

    # Larger blocks of codes

    def _join(self) -> None:
        """Join blocks of codes, so that a search need not read every code; searches go on meanwhile."""
        if not self._joining.acquire(blocking=False):
            return
        try:
            while (held := self._held) is not None and (table := held.snapshot.table) is not None:
                block = table.joined()
                if block is None:
                    return
                with self._lock:
                    now = self._held
                    if now is None or now.source is not held.source or now.snapshot.table is None:
                        return
                    self._held = replace(now, snapshot=now.snapshot.with_block(block))
        except Exception:
            log.exception("The codes of map %d could not be joined; searches read all of them", self._map)
        finally:
            self._joining.release()


def tier_of(snapshot: Snapshot) -> Tier:
    """How a snapshot is searched."""
    return "exact" if snapshot.table is None else "compact"


def _both(
    connection: MapConnection, record: MapRecord, first: int, offsets: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int8]]]:
    """Descriptors and cells of rows, some at a time; rows that are gone are left out.

    Args:
        offsets: of the rows, from ``first`` on.
    """
    form = Form(record)
    for start in range(0, len(offsets), DESCRIPTORS_AT_ONCE):
        some = offsets[start : start + DESCRIPTORS_AT_ONCE]
        stored = rows.both_at(connection, (first + some).tolist())
        there = np.array([offset for offset in some.tolist() if first + offset in stored], np.int64)
        if len(there):
            found = [stored[first + offset] for offset in there.tolist()]
            yield there, form.descriptors([one for one, _ in found]), form.locals([other for _, other in found])


def _locations(where: Whereabouts) -> Iterator[Location]:
    columns = (
        where.kind, where.position, where.sequence, where.ordinal, where.heading, where.timestamp, where.track,
        where.station, where.least, where.level, where.height, where.accuracy,
    )  # fmt: skip
    for kind, position, *others in zip(*(column.tolist() for column in columns), strict=True):
        yield Location(kind, tuple(position), *others)
