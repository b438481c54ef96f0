"""Consecutive rows of a map: where their places are and, in a map that is searched exactly, their descriptors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import faiss
import numpy as np
from numpy.typing import NDArray

from core.storage.resting import Descriptor, Local
from core.storage.spots import Spot, joined, memory_of, whereabouts_of
from core.verdict import Whereabouts

_SMALLEST_TAIL = 8


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
class Held:
    """Descriptors of a segment in memory.

    index: holds the segment's rows, and behind them room that nobody reads.
    local: the local descriptors of the same rows, int8 [capacity, C, L], with the same room behind them.
    """

    index: faiss.IndexFlatIP
    local: Local

    @classmethod
    def nothing(cls, dimension: int, local_shape: tuple[int, int]) -> Held:
        """Of a segment without rows."""
        return cls(flat_index(0, dimension), np.empty((0, *local_shape), np.int8))

    def appended(self, n: int, descriptors: Sequence[Descriptor], local: Sequence[Local], largest: int) -> Held:
        """With more rows behind the first ``n``, in memory that is shared where it suffices."""
        index, cells, end = self.index, self.local, n + len(descriptors)
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
        return Held(index, cells)


class Reading:
    """As long as this lives, the file of a segment may be read."""


@dataclass(frozen=True, eq=False)
class Segment:
    """Consecutive rows of a map.

    held: their descriptors, or None: they are on the shelf (:class:`core.storage.shelf.Shelf`).
    first_row: the map's row that is row 0 here.
    alive: bool [n], False for the rows of places that were forgotten or got another frame.
    checksums: uint32 [n], what SQLite names of each row; 0 where it names none.
    reading: is shared by all states of the segment in which its file may be read.
    removed: no row is alive, and there are no descriptors any more, in memory or on the shelf.
    """

    held: Held | None
    first_row: int
    whereabouts: Whereabouts
    alive: NDArray[np.bool_]
    checksums: NDArray[np.uint32]
    reading: Reading = field(default_factory=Reading)
    removed: bool = False

    def __len__(self) -> int:
        return len(self.alive)

    @property
    def index(self) -> faiss.IndexFlatIP:
        """Of a segment that holds its descriptors."""
        assert self.held is not None
        return self.held.index

    @property
    def local(self) -> Local:
        """Of a segment that holds its descriptors: int8 [capacity, C, L]."""
        assert self.held is not None
        return self.held.local

    @property
    def memory(self) -> int:
        """Bytes that the segment takes."""
        held = 0 if self.held is None else self.index.ntotal * self.index.d * 4 + self.local.nbytes
        return held + memory_of(self.whereabouts) + self.alive.nbytes + self.checksums.nbytes

    def appended(
        self,
        descriptors: Sequence[Descriptor],
        spots: Sequence[Spot],
        local: Sequence[Local],
        checksums: Sequence[int],
        largest: int,
    ) -> Segment:
        """With more rows.  Only on the newest segment, by one thread: the room behind it is shared."""
        return replace(
            self,
            held=None if self.held is None else self.held.appended(len(self), descriptors, local, largest),
            whereabouts=joined([self.whereabouts, whereabouts_of(spots)]),
            alive=np.concatenate([self.alive, np.ones(len(descriptors), dtype=np.bool_)]),
            checksums=np.concatenate([self.checksums, np.array(checksums, dtype=np.uint32)]),
        )

    def moved(self, spots: Mapping[int, Spot]) -> Segment:
        """With some of the map's rows somewhere else."""
        old = self.whereabouts
        new = old.take(np.arange(len(old)))
        for row, spot in spots.items():
            offset = row - self.first_row
            new.kind[offset], new.position[offset] = spot.kind, spot.position
            new.sequence[offset], new.ordinal[offset] = spot.sequence, spot.ordinal
            new.heading[offset], new.timestamp[offset] = spot.heading, spot.timestamp
        return replace(self, whereabouts=new)

    def without(self, rows: Sequence[int]) -> Segment:
        """With some of the map's rows dead."""
        dead = np.asarray(rows, dtype=np.int64) - self.first_row
        alive, checksums = self.alive.copy(), self.checksums.copy()
        alive[dead], checksums[dead] = False, 0
        return replace(self, alive=alive, checksums=checksums)

    @cached_property
    def living(self) -> int:
        """How many rows are alive."""
        return int(np.count_nonzero(self.alive))

    @property
    def has_life(self) -> bool:
        """Whether any row is alive."""
        return self.living > 0

    def without_rows(self) -> Segment:
        """Removed: without descriptors, and without a hold on its file."""
        return replace(self, held=None, reading=Reading(), removed=True)

    def search(
        self,
        queries: NDArray[np.float32],
        start: int,
        stop: int,
        products: NDArray[np.float32],
        allowed: NDArray[np.bool_] | None = None,
    ) -> None:
        """Put the inner products of ``queries`` [B, D] with rows start … stop into ``products`` [B, stop - start].

        Args:
            allowed: bool [stop - start]; the others are not read, and their products not touched.
        """
        count = stop - start if allowed is None else int(allowed.sum())
        if not count:
            return
        if allowed is None or count == stop - start:
            selected: faiss.IDSelector = faiss.IDSelectorRange(start, stop)
        else:
            bits = np.packbits(np.concatenate([np.zeros(start, np.bool_), allowed]), bitorder="little")
            selected = faiss.IDSelectorBitmap(len(bits), faiss.swig_ptr(bits))
        parameters = faiss.SearchParameters()
        parameters.sel = selected
        found, labels = self.index.search(queries, count, params=parameters)
        np.put_along_axis(products, labels - start, found, axis=1)
