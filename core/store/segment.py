"""A segment of a map in memory: where the places of its rows are and, where the map holds them, descriptors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, nan

import faiss
import numpy as np
from numpy.typing import NDArray

from core.index.flat import Vectors, flat_index, products, vectors
from core.maps.forms import Descriptor, Local
from core.places import NO_LEVEL, NO_TIME, Whereabouts

_SMALLEST_TAIL = 8


@dataclass(frozen=True)
class Location:
    """Where one place is; the fields are those of :class:`Whereabouts`, of which None is a track of its own."""

    kind: int
    position: tuple[float, float, float]
    sequence: int
    ordinal: int
    heading: float = nan
    timestamp: int = NO_TIME
    track: int | None = None
    station: int | None = None
    least: float = -inf
    level: int = NO_LEVEL
    height: float = nan
    accuracy: float = nan


def whereabouts_of(locations: Sequence[Location]) -> Whereabouts:
    """The whereabouts of n places, in their order."""
    return Whereabouts(
        np.array([location.kind for location in locations], dtype=np.int8),
        np.array([location.position for location in locations], dtype=np.float64).reshape(-1, 3),
        np.array([location.sequence for location in locations], dtype=np.int32),
        np.array([location.ordinal for location in locations], dtype=np.int64),
        np.array([location.heading for location in locations], dtype=np.float32),
        np.array([location.timestamp for location in locations], dtype=np.int64),
        np.array([one.sequence if one.track is None else one.track for one in locations], dtype=np.int32),
        np.array([one.ordinal if one.station is None else one.station for one in locations], dtype=np.int64),
        np.array([location.least for location in locations], dtype=np.float32),
        np.array([location.level for location in locations], dtype=np.int32),
        np.array([location.height for location in locations], dtype=np.float64),
        np.array([location.accuracy for location in locations], dtype=np.float32),
    )


def memory_of(whereabouts: Whereabouts) -> int:
    """Bytes of the columns."""
    columns = vars(whereabouts).values()
    return sum(column.nbytes for column in columns)


@dataclass(frozen=True, eq=False)
class HeldRows:
    """The descriptors of a segment in memory.

    index: the segment's rows, followed by room for further rows.
    local: the local descriptors of the same rows, int8 [capacity, C, L], with the same room.
    """

    index: faiss.IndexFlatCodes
    local: Local

    @cached_property
    def rows(self) -> Vectors:
        """The descriptors in the index, without a copy."""
        return vectors(self.index)

    @classmethod
    def nothing(cls, dimension: int, local_shape: tuple[int, int], halves: bool = False) -> HeldRows:
        """The descriptors of a segment without rows."""
        return cls(flat_index(0, dimension, halves), np.empty((0, *local_shape), np.int8))

    def appended(
        self, n: int, descriptors: Sequence[Descriptor] | Vectors, local: Sequence[Local] | Local, largest: int
    ) -> HeldRows:
        """With more rows after the first ``n``; the memory is shared if it has room for them."""
        index, cells, end = self.index, self.local, n + len(descriptors)
        if end > index.ntotal:
            # The room doubles, so that each row is copied about once over a segment's life.
            capacity = min(largest, max(end, 2 * index.ntotal, _SMALLEST_TAIL))
            index = flat_index(capacity, self.index.d, self.rows.dtype == np.float16)
            cells = np.zeros((capacity, *cells.shape[1:]), np.int8)
            vectors(index)[:n], cells[:n] = self.rows[:n], self.local[:n]
        if len(descriptors):
            vectors(index)[n:end] = descriptors
        if len(local):
            cells[n:end] = local
        return HeldRows(index, cells)


@dataclass(frozen=True, eq=False)
class Segment:
    """Consecutive rows of a map.  Immutable.

    held: their descriptors in memory; None if they are read when they are needed (:class:`core.store.rows.Rows`).
    first_row: the row of the map that is row 0 of the segment.
    alive: bool [n], False for rows of places that were deleted or got another frame.
    """

    held: HeldRows | None
    first_row: int
    whereabouts: Whereabouts
    alive: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.alive)

    @property
    def index(self) -> faiss.IndexFlatCodes:
        """The index of a segment that holds its descriptors."""
        assert self.held is not None
        return self.held.index

    @property
    def local(self) -> Local:
        """The local descriptors of a segment that holds them: int8 [capacity, C, L]."""
        assert self.held is not None
        return self.held.local

    @property
    def memory(self) -> int:
        """Bytes of memory that the segment takes."""
        held = 0 if self.held is None else vectors(self.index).nbytes + self.local.nbytes
        return held + memory_of(self.whereabouts) + self.alive.nbytes

    def appended(
        self,
        descriptors: Sequence[Descriptor] | Vectors,
        locations: Sequence[Location],
        local: Sequence[Local] | Local,
        largest: int,
    ) -> Segment:
        """With more rows.  Call it only on the newest state, from one thread: the room after the rows is shared."""
        return replace(
            self,
            held=None if self.held is None else self.held.appended(len(self), descriptors, local, largest),
            whereabouts=Whereabouts.joined([self.whereabouts, whereabouts_of(locations)]),
            alive=np.concatenate([self.alive, np.ones(len(descriptors), dtype=np.bool_)]),
        )

    def moved(self, locations: Mapping[int, Location]) -> Segment:
        """With other locations of some of the map's rows."""
        old = self.whereabouts
        new = old.take(np.arange(len(old)))
        offsets = np.array(list(locations), np.int64) - self.first_row
        for name, column in vars(whereabouts_of(list(locations.values()))).items():
            getattr(new, name)[offsets] = column
        return replace(self, whereabouts=new)

    def without(self, rows: Sequence[int]) -> Segment:
        """With some of the map's rows dead."""
        alive = self.alive.copy()
        alive[np.asarray(rows, dtype=np.int64) - self.first_row] = False
        return replace(self, alive=alive)

    @cached_property
    def living(self) -> int:
        """How many rows are alive."""
        return int(np.count_nonzero(self.alive))

    def search(self, queries: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """The inner products of ``queries`` [B, D] with some rows of the map [k] that are held: float32 [B, k].

        The rows are ascending.
        """
        return products(self.index, queries, rows - self.first_row)
