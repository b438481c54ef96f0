"""What is searched: an immutable view of a map, made of FAISS flat inner-product indexes.

A map's rows lie in segments of a fixed size; the last one, the tail, still grows.  A write makes a
new snapshot that shares every index, and the local descriptors beside it, with the one before:
descriptors are put behind the rows that older snapshots see, and only the few bytes per row that say
where a place is, and whether it is still alive, are copied, for the segments that the write touches.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise

import faiss
import numpy as np
from numpy.typing import NDArray

from core.storage.descriptors import NO_LOCAL, Descriptor, Local
from core.verdict import Whereabouts

Ranking = tuple[NDArray[np.int64], NDArray[np.float32]]
"""Rows, best first, and their inner products."""

_SMALLEST_TAIL = 8
_PART_BYTES = 32 << 20  # of descriptors that one thread compares at a time: about a millisecond's work


@dataclass(frozen=True)
class Spot:
    """Where one place is; the fields are those of :class:`Whereabouts`."""

    kind: int
    position: tuple[float, float, float]
    sequence: int
    ordinal: int


def whereabouts_of(spots: Sequence[Spot]) -> Whereabouts:
    """Of n places, row-aligned."""
    return Whereabouts(
        np.array([spot.kind for spot in spots], dtype=np.int8),
        np.array([spot.position for spot in spots], dtype=np.float64).reshape(-1, 3),
        np.array([spot.sequence for spot in spots], dtype=np.int32),
        np.array([spot.ordinal for spot in spots], dtype=np.int64),
    )


def joined(parts: Sequence[Whereabouts]) -> Whereabouts:
    """One after the other."""
    if not parts:
        return whereabouts_of([])
    return Whereabouts(
        np.concatenate([part.kind for part in parts]),
        np.concatenate([part.position for part in parts]),
        np.concatenate([part.sequence for part in parts]),
        np.concatenate([part.ordinal for part in parts]),
    )


def flat_index(capacity: int, dimension: int) -> faiss.IndexFlatIP:
    """An inner-product index with room for ``capacity`` rows, all zero, to be filled through :func:`vectors`."""
    index = faiss.IndexFlatIP(dimension)
    index.codes.resize(capacity * dimension * 4)
    index.ntotal = capacity
    return index


def vectors(index: faiss.IndexFlatIP) -> NDArray[np.float32]:
    """The rows of an index itself, not a copy: float32 [capacity, D], valid as long as the index is."""
    size = index.ntotal * index.d
    flat: NDArray[np.float32] = faiss.rev_swig_ptr(index.get_xb(), size) if size else np.empty(0, np.float32)
    return flat.reshape(index.ntotal, index.d)


@dataclass(frozen=True, eq=False)
class Segment:
    """Consecutive rows of a map.

    index: holds ``len(self)`` rows, and behind them room that nobody reads.
    local: the local descriptors of the same rows, int8 [capacity, C, L], with the same room behind them.
    first_row: the map's row that is row 0 here.
    alive: bool [n], False for the rows of places that were forgotten or got another frame.
    """

    index: faiss.IndexFlatIP
    local: Local
    first_row: int
    whereabouts: Whereabouts
    alive: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.alive)

    def appended(
        self, descriptors: Sequence[Descriptor], spots: Sequence[Spot], local: Sequence[Local], largest: int
    ) -> Segment:
        """With more rows.  Only on the newest segment, by one thread: the room behind it is shared."""
        n, end = len(self), len(self) + len(descriptors)
        index, cells = self.index, self.local
        if end > index.ntotal:
            # Doubling: over a segment's life each row is copied about once.
            capacity = min(largest, max(end, 2 * index.ntotal, _SMALLEST_TAIL))
            index, cells = flat_index(capacity, self.index.d), np.zeros((capacity, *cells.shape[1:]), np.int8)
            vectors(index)[:n], cells[:n] = vectors(self.index)[:n], self.local[:n]
        rows = vectors(index)
        for offset, descriptor in enumerate(descriptors, start=n):
            rows[offset] = descriptor
        for offset, of_frame in enumerate(local, start=n):
            cells[offset] = of_frame
        return replace(
            self,
            index=index,
            local=cells,
            whereabouts=joined([self.whereabouts, whereabouts_of(spots)]),
            alive=np.concatenate([self.alive, np.ones(len(descriptors), dtype=np.bool_)]),
        )

    def moved(self, spots: Mapping[int, Spot]) -> Segment:
        """With some of the map's rows somewhere else."""
        old = self.whereabouts
        new = Whereabouts(old.kind.copy(), old.position.copy(), old.sequence.copy(), old.ordinal.copy())
        for row, spot in spots.items():
            offset = row - self.first_row
            new.kind[offset], new.position[offset] = spot.kind, spot.position
            new.sequence[offset], new.ordinal[offset] = spot.sequence, spot.ordinal
        return replace(self, whereabouts=new)

    def without(self, rows: Sequence[int]) -> Segment:
        """With some of the map's rows dead."""
        alive = self.alive.copy()
        alive[np.asarray(rows, dtype=np.int64) - self.first_row] = False
        return replace(self, alive=alive)

    def search(self, queries: NDArray[np.float32], start: int, stop: int, products: NDArray[np.float32]) -> None:
        """Put the inner products of ``queries`` [B, D] with rows start … stop into ``products`` [B, stop - start]."""
        parameters, selected = faiss.SearchParameters(), faiss.IDSelectorRange(start, stop)
        parameters.sel = selected
        found, labels = self.index.search(queries, stop - start, params=parameters)
        np.put_along_axis(products, labels - start, found, axis=1)


@dataclass(frozen=True, eq=False)
class _Part:
    """Rows start … stop of a segment."""

    segment: Segment
    start: int
    stop: int


@cache
def _threads() -> tuple[ThreadPoolExecutor, int]:
    """Threads shared by all maps, one for each core that this process may use."""
    count = len(os.sched_getaffinity(0))
    # Each is one core's worth of work already; FAISS is not to make threads of its own below it.
    pool = ThreadPoolExecutor(count, thread_name_prefix="search", initializer=faiss.omp_set_num_threads, initargs=(1,))
    return pool, count


def _together(run: Callable[[_Part], None], parts: Sequence[_Part], calling_too: bool) -> None:
    """Run every part once, on as many threads as there are cores.

    Each thread takes the next part when it has done one, so that a core that is busy elsewhere
    delays nothing but the part it is at; a helper that has not begun by the end is not waited for.
    """
    if len(parts) == 1:
        run(parts[0])
        return
    pool, cores = _threads()
    waiting = deque(parts)

    def work() -> None:
        while True:
            try:
                part = waiting.popleft()
            except IndexError:
                return
            run(part)

    helpers = [pool.submit(work) for _ in range(min(len(parts), cores) - calling_too)]
    if calling_too:
        work()
    for helper in helpers:
        if not (calling_too and helper.cancel()):
            helper.result()


@dataclass(frozen=True, eq=False)
class Snapshot:
    """All places of a map at one moment.  ``rows_per_segment`` and ``local_shape``, (C, L), are the map's."""

    dimension: int
    rows_per_segment: int
    segments: tuple[Segment, ...] = ()
    local_shape: tuple[int, int] = NO_LOCAL

    def __len__(self) -> int:
        return len(self._living)

    @property
    def rows(self) -> int:
        """Rows ever written, those of forgotten places included."""
        return self.segments[-1].first_row + len(self.segments[-1]) if self.segments else 0

    @cached_property
    def whereabouts(self) -> Whereabouts:
        """By row, dead rows included: take the rows that :meth:`search` returns."""
        return joined([segment.whereabouts for segment in self.segments])

    @cached_property
    def _living(self) -> NDArray[np.int64]:
        """The rows of living places, ascending."""
        parts = [np.flatnonzero(segment.alive) + segment.first_row for segment in self.segments]
        return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)

    @cached_property
    def _parts(self) -> list[_Part]:
        """The rows to compare with, in parts of equal size within a segment; segments of the dead are left out."""
        parts = []
        for segment in self.segments:
            if segment.alive.any():
                count = -(-len(segment) * self.dimension * 4 // _PART_BYTES)
                ends = [len(segment) * i // count for i in range(count + 1)]
                parts += [_Part(segment, start, stop) for start, stop in pairwise(ends) if stop > start]
        return parts

    def search(self, descriptor: Descriptor) -> Ranking:
        """Every living place, best first; equal ones by row.

        Args:
            descriptor: float32 [D], finite.

        Returns:
            rows int64 [n] and inner products float32 [n], n = len(self).
        """
        return self.search_batch(descriptor[np.newaxis])[0]

    def search_batch(self, descriptors: NDArray[np.float32]) -> list[Ranking]:
        """The same for each of ``descriptors``, float32 [B, D].

        One FAISS search per segment and thread for all of them, which reads each place once, not B
        times.  Inner products may differ in their last bits from those of :meth:`search`.
        """
        queries = np.ascontiguousarray(descriptors, dtype=np.float32)
        if queries.ndim != 2 or queries.shape[1] != self.dimension or not np.isfinite(queries).all():
            raise ValueError(f"a query is {self.dimension} finite values")
        products = np.empty((len(queries), self.rows), dtype=np.float32)

        def compare(part: _Part) -> None:
            first = part.segment.first_row
            part.segment.search(queries, part.start, part.stop, products[:, first + part.start : first + part.stop])

        if len(queries) and self._parts:
            # With many queries FAISS would start threads of its own in a thread that is not one of ours.
            _together(compare, self._parts, calling_too=len(queries) == 1)
        return [self._ranked(row) for row in products]

    def _ranked(self, products: NDArray[np.float32]) -> Ranking:
        living = self._living
        found = products if len(living) == len(products) else products[living]
        order = np.argsort(-found, kind="stable")
        return living[order], found[order]

    def locals_at(self, rows: NDArray[np.int64]) -> Local:
        """The local descriptors of rows, as :meth:`search` returns them: int8 [k, C, L], a copy.

        Raises:
            IndexError: there is no such row.
        """
        if len(rows) and not 0 <= rows.min() <= rows.max() < self.rows:
            raise IndexError(f"the map has rows 0 to {self.rows - 1}")
        found = np.empty((len(rows), *self.local_shape), np.int8)
        for position, row in enumerate(rows.tolist()):
            segment = self.segments[row // self.rows_per_segment]
            found[position] = segment.local[row - segment.first_row]
        return found

    def appended(
        self, descriptors: Sequence[Descriptor], spots: Sequence[Spot], local: Sequence[Local] = ()
    ) -> Snapshot:
        """With further places.  Only on the newest snapshot, by one thread at a time.

        Args:
            descriptors, spots, local: one of each a place, float32 [D] and int8 [C, L]; ``local`` may be
                left out where the map has no local descriptors.
        """
        if self.local_shape != NO_LOCAL and len(local) != len(descriptors):
            raise ValueError("every place of this map has local descriptors")
        segments, done = list(self.segments), 0
        while done < len(descriptors):
            if not segments or len(segments[-1]) == self.rows_per_segment:
                row = sum(len(segment) for segment in segments)
                empty = np.empty(0, dtype=np.bool_)
                no_local = np.empty((0, *self.local_shape), np.int8)
                segments.append(Segment(flat_index(0, self.dimension), no_local, row, whereabouts_of([]), empty))
            stop = done + self.rows_per_segment - len(segments[-1])
            segments[-1] = segments[-1].appended(
                descriptors[done:stop], spots[done:stop], local[done:stop], self.rows_per_segment
            )
            done = min(stop, len(descriptors))
        return replace(self, segments=tuple(segments))

    def moved(self, spots: Mapping[int, Spot]) -> Snapshot:
        """With the places of some rows somewhere else."""
        segments = list(self.segments)
        for number, rows in self._by_segment(list(spots)).items():
            segments[number] = segments[number].moved({row: spots[row] for row in rows})
        return replace(self, segments=tuple(segments))

    def without(self, rows: Sequence[int]) -> Snapshot:
        """With some rows dead."""
        segments = list(self.segments)
        for number, dead in self._by_segment(rows).items():
            segments[number] = segments[number].without(dead)
        return replace(self, segments=tuple(segments))

    def _by_segment(self, rows: Sequence[int]) -> dict[int, list[int]]:
        groups: dict[int, list[int]] = {}
        for row in rows:
            groups.setdefault(row // self.rows_per_segment, []).append(row)
        return groups
