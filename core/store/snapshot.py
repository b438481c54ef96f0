"""Searching a map: an immutable snapshot of its places.

A map's rows lie in segments of a fixed size, of which the last one still grows.  A write makes a new snapshot that
shares descriptors and codes with the one before: rows are added after those that older snapshots see, and only the few
bytes per row that say where a place is and whether it is alive are copied, for the segments that the write touches.

In a map of a few places every place is compared (the tier ``exact``).  A larger map has codes of its descriptors
(``compact``), which choose the few places that are compared exactly; their descriptors are in memory or, in larger
maps, read when they are needed.  Rows without a code are compared exactly, so that the whole map is always searched.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property
from threading import Barrier
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from core.index import Codes, CodeTable
from core.index.flat import Vectors, ranked, vectors
from core.index.table import Block, FirstStage
from core.maps.forms import NO_LOCAL, Descriptor, Local
from core.places import Neighborhood, Whereabouts
from core.store.rows import Rows
from core.store.segment import HeldRows, Location, Segment, whereabouts_of
from core.threads import cores, in_turns, keep_to

__all__ = ["SHORTLIST", "Location", "Ranking", "Scope", "Segment", "Snapshot", "merged"]

SHORTLIST = 100
"""Places of a map with codes whose descriptors are compared exactly; rankings of such a map hold only these."""

_SHARED_FROM = 512  # rows in memory that one thread compares alone, in a millisecond or two

Part = TypeVar("Part")

Ranking = tuple[NDArray[np.int64], NDArray[np.float32]]
"""Rows, best first, and their inner products."""


def merged(a: Ranking, b: Ranking) -> Ranking:
    """The rows of two rankings of one map, best first."""
    rows, first = np.unique(np.concatenate([a[0], b[0]]), return_index=True)
    products = np.concatenate([a[1], b[1]])[first]
    order = np.argsort(-products, kind="stable")
    return rows[order], products[order]


@cache
def threads() -> tuple[ThreadPoolExecutor, int]:
    """The threads that the searches of all maps share, one per core that the process may use; and their number."""
    count = cores()
    pool = ThreadPoolExecutor(count, "search", keep_to, (None,))
    # They are all started now, because a thread inherits the niceness of its starter for good.
    begun = Barrier(count)
    for _ in range(count):
        pool.submit(begun.wait)
    return pool, count


def together(run: Callable[[Part], None], parts: Sequence[Part]) -> None:
    """Run every part once, on the calling thread and others, together at most one thread per core."""
    helpers = min(len(parts), cores()) - 1
    in_turns(run, parts, threads()[0] if helpers > 0 else None, helpers)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """All places of a map at one moment.  Immutable; any thread may search it.

    dimension, rows_per_segment, local_shape: of the map; ``local_shape`` is (C, L).
    source: reads the descriptors of segments that hold none in memory.
    table: has the codes of the first ``len(table)`` rows; None in a map that is searched exactly.
    holds: whether descriptors are held in memory, those of new rows too.
    halves: descriptors in memory are in half precision, in which they are also stored.
    """

    dimension: int
    rows_per_segment: int
    segments: tuple[Segment, ...] = ()
    local_shape: tuple[int, int] = NO_LOCAL
    source: Rows | None = None
    table: FirstStage | None = None
    holds: bool = True
    halves: bool = False

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> int:
        """Rows ever written, including those of deleted places."""
        return self.segments[-1].first_row + len(self.segments[-1]) if self.segments else 0

    @property
    def coded(self) -> int:
        """Rows that have a code."""
        return 0 if self.table is None else len(self.table)

    @cached_property
    def whereabouts(self) -> Whereabouts:
        """The whereabouts of all rows, including dead ones; index it by the rows that :meth:`search` returns."""
        return Whereabouts.joined([segment.whereabouts for segment in self.segments])

    def whereabouts_at(self, rows: NDArray[np.int64]) -> Whereabouts:
        """The same as ``whereabouts.take(rows)``, without concatenating all segments of a large map."""
        if len(rows) * 8 > self.rows:
            return self.whereabouts.take(rows)
        numbers, offsets = np.divmod(rows, self.rows_per_segment)
        parts = [
            self.segments[number].whereabouts.take(offsets[numbers == number]) for number in np.unique(numbers).tolist()
        ]
        by_segment = np.argsort(numbers, kind="stable")
        return Whereabouts.joined(parts).take(np.argsort(by_segment))

    @cached_property
    def alive(self) -> NDArray[np.bool_]:
        parts = [segment.alive for segment in self.segments]
        return np.concatenate(parts) if parts else np.empty(0, dtype=np.bool_)

    @cached_property
    def _count(self) -> int:
        """How many places there are; segments that a write did not touch remember their count."""
        return sum(segment.living for segment in self.segments)

    @cached_property
    def _held(self) -> NDArray[np.bool_]:
        """Whether each row is in memory: bool [rows]."""
        return np.repeat(
            np.array([segment.held is not None for segment in self.segments], np.bool_),
            np.array([len(segment) for segment in self.segments], np.int64),
        )

    @property
    def memory(self) -> int:
        """Bytes of memory that the segments and the codes take."""
        codes = 0 if self.table is None else self.table.memory
        return sum(segment.memory for segment in self.segments) + codes

    def search(self, descriptor: Descriptor, allowed: NDArray[np.bool_] | None = None) -> Ranking:
        """Rank the places of the map by inner product, best first; equal ones by row.

        Args:
            descriptor: float32 [D], finite.
            allowed: bool [rows], the rows to choose from, of which only living ones count; None: all.

        Returns:
            Rows, int64 [n], and their inner products with the stored descriptors, float32 [n]: of all allowed places
            or, in a map with codes, of the ``SHORTLIST`` or more that the codes chose.
        """
        return self.search_batch(descriptor[np.newaxis], allowed)[0]

    def search_batch(self, descriptors: NDArray[np.float32], allowed: NDArray[np.bool_] | None = None) -> list[Ranking]:
        """Rank the places for each of ``descriptors``, float32 [B, D], as :meth:`search` does.

        In a map without codes, descriptors in memory are read once for all queries.
        """
        queries = np.ascontiguousarray(descriptors, dtype=np.float32)
        if queries.ndim != 2 or queries.shape[1] != self.dimension or not np.isfinite(queries).all():
            raise ValueError(f"a query is {self.dimension} finite values")
        if allowed is not None and allowed.shape != (self.rows,):
            raise ValueError(f"allowed must have {self.rows} values, one for each row")
        if not len(queries):
            return []
        chosen = self.alive if allowed is None else self.alive & allowed
        by_code = chosen[: self.coded]
        if self.table is None or int(np.count_nonzero(by_code)) <= SHORTLIST:
            rows = np.flatnonzero(chosen)  # there are no codes, or so few places that all are compared
            return [ranked(rows, found) for found in self._compared(queries, rows)]
        others = self.coded + np.flatnonzero(chosen[self.coded :])
        exact = self._compared(queries, others)
        shortlists = self.table.shortlists(queries, SHORTLIST, None if by_code.all() else by_code, threads()[0])
        rankings = []
        for query, found, (short, _) in zip(queries[:, np.newaxis], exact, shortlists, strict=True):
            short, (later, products) = np.sort(short), _best(others, found, SHORTLIST)
            products = np.concatenate([self._compared(query, short)[0], products])
            rankings.append(ranked(np.concatenate([short, later]), products))
        return rankings

    def among(self, allowed: NDArray[np.bool_]) -> Scope:
        """The places of some rows, bool [rows], as a scope without a prior."""
        return Scope(self, allowed)

    def _compared(self, queries: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Inner products of queries with ascending rows, wherever they are: float32 [B, k]."""
        products = np.empty((len(queries), len(rows)), np.float32)
        held = self._held[rows]
        self._compare_held(queries, rows, np.flatnonzero(held), products)
        if not held.all():
            self._compare_stored(queries, rows, np.flatnonzero(~held), products)
        return products

    def _compare_held(
        self,
        queries: NDArray[np.float32],
        rows: NDArray[np.int64],
        at: NDArray[np.int64],
        products: NDArray[np.float32],
    ) -> None:
        """Products with the rows at some positions, which are in memory, a segment at a time."""
        ends = np.flatnonzero(np.diff(rows[at] // self.rows_per_segment)) + 1
        parts = [part for part in np.split(at, ends) if len(part)]

        def compare(part: NDArray[np.int64]) -> None:
            segment = self.segments[int(rows[part[0]]) // self.rows_per_segment]
            products[:, part] = segment.search(queries, rows[part])

        if len(at) < _SHARED_FROM:
            for part in parts:
                compare(part)
        else:
            together(compare, parts)

    def _compare_stored(
        self,
        queries: NDArray[np.float32],
        rows: NDArray[np.int64],
        at: NDArray[np.int64],
        products: NDArray[np.float32],
    ) -> None:
        """Products with the rows at some positions, which are read."""
        assert self.source is not None
        source, step = self.source, self.source.part_rows

        def compare(part: NDArray[np.int64]) -> None:
            products[:, part] = source.inner_products(queries, rows[part])

        together(compare, [at[start : start + step] for start in range(0, len(at), step)])

    def _check_rows(self, rows: NDArray[np.int64]) -> None:
        if len(rows) and not 0 <= rows.min() <= rows.max() < self.rows:
            raise IndexError(f"the map has rows 0 to {self.rows - 1}")

    def locals_at(self, rows: NDArray[np.int64]) -> Local:
        """A copy of the local descriptors of rows that :meth:`search` returned: int8 [k, C, L].

        Raises:
            IndexError: there is no such row.
            UnknownPlace: the place of a row was deleted a while ago.
        """
        found = np.empty((len(rows), *self.local_shape), np.int8)
        self._read(rows, found, lambda segment: segment.local, "locals")
        return found

    def descriptors_at(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """A copy of the descriptors of rows: float32 [k, D].

        Raises:
            IndexError: there is no such row.
            UnknownPlace: the place of a row was deleted a while ago.
        """
        found = np.empty((len(rows), self.dimension), np.float32)
        self._read(rows, found, lambda segment: vectors(segment.index), "descriptors")
        return found

    def _read(
        self,
        rows: NDArray[np.int64],
        found: NDArray[Any],
        in_memory: Callable[[Segment], NDArray[Any]],
        stored: Literal["descriptors", "locals"],
    ) -> None:
        """Fill ``found`` with the data of rows: those of a segment in memory at once, others as they are read."""
        self._check_rows(rows)
        held = self._held[rows]
        numbers, offsets = np.divmod(rows, self.rows_per_segment)
        # One copy a segment: between copies of single rows, threads would wait for each other's turn to run Python.
        for number in np.unique(numbers[held]).tolist():
            there = np.flatnonzero(held & (numbers == number))
            of_segment = in_memory(self.segments[number])
            if len(there) == len(rows) and of_segment.dtype == found.dtype:
                np.take(of_segment, offsets, axis=0, out=found, mode="clip")
            else:
                found[there] = np.take(of_segment, offsets[there], axis=0)
        if not held.all():
            assert self.source is not None
            found[~held] = getattr(self.source, stored)(rows[~held])

    def appended(
        self,
        descriptors: Sequence[Descriptor] | Vectors,
        locations: Sequence[Location],
        local: Sequence[Local] | Local = (),
        codes: Codes | None = None,
    ) -> Snapshot:
        """The snapshot with further places.  Call it only on the newest snapshot, from one thread at a time.

        Args:
            descriptors, locations, local: one of each per place, float32 [D] (or float16 in a map that holds halves)
                and int8 [C, L]; ``local`` may be left out if the map has no local descriptors.
            codes: of the descriptors; None: they are computed.
        """
        if self.local_shape != NO_LOCAL and len(local) != len(descriptors):
            raise ValueError("every place of this map has local descriptors")
        segments, done = list(self.segments), 0
        while done < len(descriptors):
            if not segments or len(segments[-1]) == self.rows_per_segment:
                row = sum(len(segment) for segment in segments)
                held = HeldRows.nothing(self.dimension, self.local_shape, self.halves) if self.holds else None
                segments.append(Segment(held, row, whereabouts_of([]), np.empty(0, dtype=np.bool_)))
            stop = done + self.rows_per_segment - len(segments[-1])
            segments[-1] = segments[-1].appended(
                descriptors[done:stop], locations[done:stop], local[done:stop], self.rows_per_segment
            )
            done = min(stop, len(descriptors))
        table = self.table
        if table is not None and len(table) == self.rows and len(descriptors):
            made = table.coder.encode(np.asarray(descriptors, np.float32)) if codes is None else codes
            table = table.appended(made)
        return replace(self, segments=tuple(segments), table=table)

    def moved(self, locations: Mapping[int, Location]) -> Snapshot:
        """The snapshot with other locations of some rows."""
        segments = list(self.segments)
        for number, rows in self._by_segment(list(locations)).items():
            segments[number] = segments[number].moved({row: locations[row] for row in rows})
        return replace(self, segments=tuple(segments))

    def without(self, rows: Sequence[int]) -> Snapshot:
        """The snapshot without the places of some rows."""
        segments = list(self.segments)
        for number, dead in self._by_segment(rows).items():
            segments[number] = segments[number].without(dead)
        return replace(self, segments=tuple(segments))

    def _by_segment(self, rows: Sequence[int]) -> dict[int, list[int]]:
        groups: dict[int, list[int]] = {}
        for row in rows:
            groups.setdefault(row // self.rows_per_segment, []).append(row)
        return groups

    def with_block(self, block: Block) -> Snapshot:
        """The snapshot with a block that :meth:`CodeTable.joined` made of some of its codes."""
        assert isinstance(self.table, CodeTable)
        return replace(self, table=self.table.with_block(block))


@dataclass(frozen=True, eq=False)
class Scope:
    """The rows of a snapshot that a query may find, and their prior weights.

    allowed: bool [rows]; None: all rows.
    weights: float64 [rows], at most 0, the log prior that is added to the log odds of a place; None: no prior.
    """

    snapshot: Snapshot
    allowed: NDArray[np.bool_] | None = None
    weights: NDArray[np.float64] | None = None

    @property
    def favoured(self) -> NDArray[np.bool_] | None:
        """The allowed rows that the prior favours, whose weight is nearer to 0 than to the lowest; None if no prior."""
        if self.weights is None:
            return None
        favoured = self.weights >= self.weights.min() / 2
        return favoured if self.allowed is None else favoured & self.allowed

    def search(self, descriptors: NDArray[np.float32]) -> list[Ranking]:
        """Rank the places of the scope by inner product, for each of the queries, float32 [B, D].

        A large map returns only its best places, among which a place that the prior favours may be missing.  So the
        places that the prior favours are searched a second time alone, and the rankings are merged.
        """
        rankings = self.snapshot.search_batch(descriptors, self.allowed)
        if len(rankings[0][0]) >= len(self.snapshot) or (favoured := self.favoured) is None:
            return rankings
        more = self.snapshot.search_batch(descriptors, favoured)
        return [merged(ranking, other) for ranking, other in zip(rankings, more, strict=True)]

    def search_elsewhere(
        self, descriptor: Descriptor, ranking: Ranking, best: int, neighborhood: Neighborhood | None
    ) -> Ranking:
        """The best places that are neither in a ranking nor the same place as the row ``best``; no rows if none are."""
        where = self.snapshot.whereabouts
        elsewhere = self.snapshot.alive & ~where.of_views(ranking[0])
        if neighborhood is not None:
            elsewhere &= ~where.near(best, neighborhood)
        elsewhere[ranking[0]] = False
        if self.allowed is not None:
            elsewhere &= self.allowed
        if not elsewhere.any():
            return np.empty(0, np.int64), np.empty(0, np.float32)
        return self.snapshot.search(descriptor, elsewhere)

    def weights_at(self, rows: NDArray[np.int64]) -> NDArray[np.float64] | None:
        """The log prior of rows, float64 [n]; None if there is no prior."""
        return None if self.weights is None else self.weights[rows]

    def living_rows(self) -> NDArray[np.int64]:
        alive = self.snapshot.alive
        return np.flatnonzero(alive if self.allowed is None else alive & self.allowed)


def _best(rows: NDArray[np.int64], products: NDArray[np.float32], count: int) -> Ranking:
    """The at most ``count`` rows with the largest products, ascending by row."""
    if len(rows) <= count:
        return rows, products
    chosen = np.sort(np.argpartition(-products, count)[:count])
    return rows[chosen], products[chosen]
