"""The snapshot of a map in the memory of a service, brought up to date before each query.

Every write to a map makes a revision of it, in the order of commits; it draws a stamp at random and stores it with the
revision.  A service reads, in the transaction in which it reads the revision, which places changed and which rows died
since the one that it holds.  If the stamp of that one is not stored any more, or is another one, the database was
restored or another server took over that lacks some writes: then the service forgets all that it has of the map, its
cached rows included, and reads it anew.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from core.errors import StorageFailure
from core.index import Coder, Codes, CodeTable
from core.index.flat import Vectors, flat_index, vectors
from core.ledger.maps import rows
from core.ledger.maps.checksums import DamagedRow
from core.ledger.maps.columns import Columns, read_columns
from core.ledger.maps.connection import MapConnection, Reading
from core.ledger.maps.record import MapState
from core.maps.forms import HALF, Form
from core.maps.records import MapRecord
from core.maps.status import Tier
from core.places import NO_POSE, NO_SEQUENCE, Whereabouts
from core.store.database import MapDatabase
from core.store.rows import RowCache, Rows
from core.store.segment import HeldRows, Location, Segment
from core.store.snapshot import Snapshot
from core.store.tiers import holds_for, tier_for

if TYPE_CHECKING:
    from core.index.milvus import Milvus, MilvusCodes

log = logging.getLogger(__name__)

ROWS_PER_SEGMENT = 1024
"""Rows of a segment, whose whereabouts a write copies."""

CODES_AT_ONCE = 4096
"""Codes that are read at a time."""

DESCRIPTORS_AT_ONCE = 256
"""Descriptors that are read at a time."""

IN_MILVUS_FROM = 100_000
"""From this number of frames on, the codes of a map are in Milvus, where there is one."""

MOST_BEHIND = 64
"""Rows that may be compared one by one before Milvus is given them."""

_NOWHERE = Location(NO_POSE, (0.0, 0.0, 0.0), NO_SEQUENCE, 0)


@dataclass(frozen=True, eq=False)
class Followed:
    """A snapshot, and the revision and the stamp of the map that it shows."""

    snapshot: Snapshot
    revision: int
    stamp: str
    source: Rows


class FollowedMap:
    """The snapshot of one map.  Any thread may use it.

    Args:
        database: of the map.
        glancing: begins to read the map by single statements.
        cache: of rows of all maps.
        milvus: has the codes of large maps; None: memory has those of all.
        rows_per_segment: of its snapshots.
    """

    def __init__(
        self,
        database: MapDatabase,
        glancing: Reading,
        cache: RowCache,
        milvus: Milvus | None = None,
        rows_per_segment: int = ROWS_PER_SEGMENT,
    ) -> None:
        self._database, self._glancing, self._cache, self._per_segment = database, glancing, cache, rows_per_segment
        self._milvus = milvus
        self._lock = threading.RLock()
        self._joining = threading.Lock()
        self._held: Followed | None = None
        self._given = WeakSet[Snapshot]()

    @property
    def has_older_readers(self) -> bool:
        """Whether a snapshot is in use that shows another state of the map than the last one."""
        now = None if self._held is None else self._held.snapshot
        return any(one is not now for one in self._given)

    @property
    def held(self) -> Followed | None:
        """The state in memory; None before the first use."""
        return self._held

    def forget(self) -> None:
        """Read the map anew at its next use."""
        self._held = None

    def as_of(self, state: MapState) -> Followed | None:
        """The snapshot that is held, if it shows this state; else None."""
        held = self._held
        if held is None or (held.revision, held.stamp) != (state.revision, state.stamp):
            return None
        return None if (table := held.snapshot.table) is not None and table.is_lost else held

    def up_to_date(self, connection: MapConnection, state: MapState) -> Followed:
        """The snapshot of a state of the map that was read in this transaction."""
        if (held := self.as_of(state)) is None:
            with self._lock:
                held = self.as_of(state) or self._advanced(connection, state)
        return held

    def _advanced(self, connection: MapConnection, state: MapState) -> Followed:
        held = self._held
        if held is not None and held.revision > state.revision:
            # This transaction does not see so much; and others that wait here may hold all connections of a pool.
            with self._database.fresh() as fresh:
                if self._follows(fresh, held):
                    return held  # another thread has seen more
            held = None
        if held is None or not self._follows(connection, held) or self._outgrown(state, held.snapshot):
            source = Rows(self._glancing, Form.of(state.record), self._cache)
            snapshot = self._read(connection, state, source)
        else:
            source, snapshot = held.source, self._with_changes(connection, state, held)
        self._given.add(snapshot)
        self._held = now = Followed(snapshot, state.revision, state.stamp, source)
        work = self._hand_over if self._is_for_milvus(snapshot) else self._join if _is_loose(snapshot) else None
        if work is not None and not self._joining.locked():
            threading.Thread(target=work, args=(state.record,), name="index", daemon=True).start()
        return now

    def _follows(self, connection: MapConnection, held: Followed) -> bool:
        """Whether what is held is a revision that the database has."""
        if not held.revision:
            return not held.stamp
        known = rows.stamp_of(connection, held.revision)
        if known != held.stamp:
            log.warning("A map is read anew: its revision %d is not that of the database", held.revision)
        return known == held.stamp

    def _outgrown(self, state: MapState, snapshot: Snapshot) -> bool:
        """Whether a map is to be searched in another way than it is."""
        setting, count, present = state.record.index, state.searched, tier_of(snapshot)
        if snapshot.table is not None and snapshot.table.is_lost:
            return True
        return (tier_for(setting, count, present), holds_for(setting, count, snapshot.holds)) != (
            present,
            snapshot.holds,
        )

    # Reading all

    def _read(self, connection: MapConnection, state: MapState, source: Rows) -> Snapshot:
        columns, total = _columns(connection, state), state.rows
        if len(columns.rows) != state.searched:
            counted = f"its record counts {state.searched} places and looks"
            raise DamagedRow(f"{counted}, but there are {len(columns.rows)}")
        whereabouts = columns.by_row(total)
        alive = np.zeros(total, np.bool_)
        alive[columns.rows] = True
        record = state.record
        # How the map was searched before is not known, but the number of its places allows it to be as it was.
        holds = holds_for(record.index, state.searched, True)
        segments = []
        for first in range(0, total, self._per_segment):
            part = slice(first, min(total, first + self._per_segment))
            there = Whereabouts(**{name: column[part] for name, column in vars(whereabouts).items()})
            held = self._held_rows(connection, record, first, alive[part]) if holds else None
            segments.append(Segment(held, first, there, alive[part]))
        exact = tier_for(record.index, state.searched, "exact") == "exact"
        table = None if exact else self._table(connection, record, total)
        return Snapshot(
            record.dimension, self._per_segment, tuple(segments), record.local_shape, source, table, holds,
            record.precision == HALF,
        )  # fmt: skip

    def _held_rows(
        self, connection: MapConnection, record: MapRecord, first: int, alive: NDArray[np.bool_]
    ) -> HeldRows:
        index = flat_index(len(alive), record.dimension, record.precision == HALF)
        local = np.zeros((len(alive), *record.local_shape), np.int8)
        offsets = np.flatnonzero(alive)
        for there, descriptors, cells in _both(connection, record, first, offsets):
            vectors(index)[there], local[there] = descriptors, cells
            offsets = np.setdiff1d(offsets, there, assume_unique=True)
        if len(offsets):
            raise DamagedRow(f"row {first + int(offsets[0])} has a place and no descriptors")
        return HeldRows(index, local)

    def _table(self, connection: MapConnection, record: MapRecord, total: int) -> CodeTable:
        coder = Coder.of(record.dimension)
        made, missing = coder.blank(total), np.ones(total, np.bool_)
        damaged = set[int]()
        for page in rows.every(connection, "codes", CODES_AT_ONCE, damaged):
            found = [(row, code) for row, code in page if row < total and len(code) == coder.bytes_per_place]
            if found:
                there = np.array([row for row, _ in found], np.int64)
                made[there] = np.frombuffer(b"".join(code for _, code in found), np.uint8).reshape(len(there), -1)
                missing[there] = False
        if damaged:
            log.error("The codes of %d rows of map %s are damaged and made again", len(damaged), record.id)
        self._encode(connection, record, made, np.flatnonzero(missing).tolist(), 0)
        return CodeTable.empty(coder).appended(made)

    def _encode(
        self, connection: MapConnection, record: MapRecord, codes: Codes, missing: Sequence[int], first: int
    ) -> None:
        """Compute codes that are not stored, of rows that are."""
        form, coder = Form.of(record), Coder.of(record.dimension)
        for start in range(0, len(missing), DESCRIPTORS_AT_ONCE):
            stored = rows.at(connection, "descriptors", missing[start : start + DESCRIPTORS_AT_ONCE])
            if stored:
                codes[[row - first for row in stored]] = coder.encode(form.descriptors(list(stored.values())))

    # Reading changes

    def _with_changes(self, connection: MapConnection, state: MapState, held: Followed) -> Snapshot:
        last, record = held.snapshot, state.record
        columns = _columns(connection, state, held.revision)
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
        codes = None
        if last.table is not None:
            codes, new = last.table.coder.blank(count), range(first, first + count)
            stored = rows.at(connection, "codes", new, set())
            for row, code in stored.items():
                codes[row - first] = np.frombuffer(code, np.uint8)
            self._encode(connection, record, codes, [row for row in new if row not in stored], first)
        if not last.holds:
            nothing = np.zeros((count, *record.local_shape), np.int8)
            return last.appended(np.empty((count, 0), np.float32), locations, nothing, codes)
        descriptors = np.zeros((count, record.dimension), np.float16 if last.halves else np.float32)
        local = np.zeros((count, *record.local_shape), np.int8)
        for offsets, found, cells in _both(connection, record, first, np.arange(count)):
            descriptors[offsets], local[offsets] = found, cells
        return last.appended(descriptors, locations, local, codes)

    # Larger blocks of codes

    def _join(self, record: MapRecord) -> None:
        """Join blocks of codes, so that a search need not read every code; searches go on meanwhile."""
        with self._working(record, "codes could not be joined; searches read all of them"):
            while (held := self._held) is not None and isinstance(table := held.snapshot.table, CodeTable):
                if (block := table.joined()) is None:
                    return
                self._replace(held, lambda now, block=block: now.with_block(block))  # type: ignore[misc]

    # A Milvus

    def _is_for_milvus(self, snapshot: Snapshot) -> bool:
        """Whether Milvus lacks rows of a map whose codes it is to have."""
        if self._milvus is None or (table := snapshot.table) is None or len(snapshot) < IN_MILVUS_FROM:
            return False
        return isinstance(table, CodeTable) or snapshot.rows - len(table) >= MOST_BEHIND

    def _hand_over(self, record: MapRecord) -> None:
        """Give Milvus the rows that it lacks, and search them there; searches go on as they are meanwhile."""
        with self._working(record, "descriptors could not be given to Milvus"):
            if (held := self._held) is None or self._milvus is None:
                return
            snapshot, table = held.snapshot, held.snapshot.table
            living = np.flatnonzero(snapshot.alive)
            if table is None or isinstance(table, CodeTable):
                last = int(living[-1]), snapshot.descriptors_at(living[-1:])[0]
                codes = self._milvus.codes(uid_of(record), record.dimension, snapshot.rows, last)
            else:
                codes = cast("MilvusCodes", table)
            missing = living[living >= len(codes)]
            parts = (missing[at : at + DESCRIPTORS_AT_ONCE] for at in range(0, len(missing), DESCRIPTORS_AT_ONCE))
            pairs = (pair for part in parts for pair in zip(part.tolist(), snapshot.descriptors_at(part), strict=True))
            made = codes.brought_up(pairs, snapshot.rows)
            self._replace(held, lambda now: replace(now, table=made))

    def erase(self, record: MapRecord, dead: Sequence[int]) -> None:
        """Have Milvus forget rows that no place has any more, and read the map anew, for memory has them as well.

        Raises:
            StoreUnavailable: Milvus cannot be reached.
        """
        if self._milvus is not None:
            self._milvus.delete(uid_of(record), dead)
        self.forget()

    @contextmanager
    def _working(self, record: MapRecord, failure: str) -> Iterator[None]:
        """Work in the background, one thread at a time; what fails is logged, and tried again after another write."""
        with self._joining:
            try:
                yield
            except Exception:
                log.exception("Map %s: %s", record.id, failure)

    def _replace(self, held: Followed, change: Callable[[Snapshot], Snapshot]) -> None:
        """Publish a change of the snapshot, unless the map was read anew since it was ``held``."""
        with self._lock:
            now = self._held
            if now is not None and now.source is held.source and now.snapshot.table is not None:
                self._held = replace(now, snapshot=change(now.snapshot))
                self._given.add(self._held.snapshot)


def uid_of(record: MapRecord) -> str:
    """The name of a map in Milvus; a later map of the same id has another one."""
    return hashlib.sha256(f"{record.id} {record.created_at.isoformat()}".encode()).hexdigest()[:32]


def _is_loose(snapshot: Snapshot) -> bool:
    return isinstance(snapshot.table, CodeTable) and snapshot.table.is_loose


def tier_of(snapshot: Snapshot) -> Tier:
    """How a snapshot is searched."""
    return "exact" if snapshot.table is None else "compact"


def _columns(connection: MapConnection, state: MapState, after: int | None = None) -> Columns:
    try:
        return read_columns(connection, state.rows, after)
    except (ValueError, TypeError) as error:  # values that were never written
        raise DamagedRow(f"a value of a place is invalid: {error}") from error


def _both(
    connection: MapConnection, record: MapRecord, first: int, offsets: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.int64], Vectors, NDArray[np.int8]]]:
    """Descriptors and local descriptors of rows, some at a time; rows that are gone are left out.

    Args:
        offsets: of the rows, from ``first`` on.
    """
    form = Form.of(record)
    for start in range(0, len(offsets), DESCRIPTORS_AT_ONCE):
        some = (first + offsets[start : start + DESCRIPTORS_AT_ONCE]).tolist()
        descriptors, local = (rows.at(connection, kind, some) for kind in rows.OF_FRAMES)
        there = [row for row in some if row in descriptors and row in local]
        if there:
            yield (
                np.array(there, np.int64) - first,
                form.vectors([descriptors[row] for row in there]),
                form.locals([local[row] for row in there]),
            )


def _locations(where: Whereabouts) -> Iterator[Location]:
    columns = (
        where.kind, where.position, where.sequence, where.ordinal, where.heading, where.timestamp, where.track,
        where.station, where.least, where.level, where.height, where.accuracy,
    )  # fmt: skip
    for kind, position, *others in zip(*(column.tolist() for column in columns), strict=True):
        yield Location(kind, tuple(position), *others)
