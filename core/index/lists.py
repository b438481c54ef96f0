"""Inverted lists: rows by the nearest of some centres, so that a query looks at the likeliest of them only.

Sivic and Zisserman, ICCV 2003; over compact codes, Jégou, Douze and Schmid, PAMI 33(1), 2011.  Centres are found by
spherical k-means (FAISS) on sketches, their bits taken as 1 and -1: lists are made of the codes alone, no descriptor
has to be read again.  A list holds its rows' ids and a second copy of their sketches, side by side: to pick them row by
row out of the table would take as long as to go through all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from core.index.best_estimates import best_positions, together
from core.index.codes import Bits, CodedQuery
from core.index.table import CodeTable
from core.kernels.codes import GROUP_BITS, estimates_of

Array = NDArray[np.float32]
Rows = NDArray[np.int64]

PROBED_SHARE = 0.2
"""Share of the rows that a query looks at; lists are taken in turn, nearest first, until it is reached."""
_LISTS_PER_ROOT = 2.0
_SAMPLED_PER_LIST = 64
_ROUNDS = 10
_AT_ONCE = 16_384
_LISTS_PER_TASK = 64

Progress = Callable[[int, int], None]


def _untold(done: int, total: int) -> None:
    """Nobody is told."""


@dataclass(frozen=True, eq=False)
class InvertedLists:
    """Rows by the nearest of some hundreds of centres.  Immutable.

    centers: float32 [c, 512], of unit length.
    order: int64 [rows], row ids, list by list, ascending within one.
    ends: int64 [c], where each list ends.
    sketches: uint64 [rows, S], scales: float32 [rows], in that order.
    """

    centers: Array
    order: Rows
    ends: Rows
    sketches: Bits
    scales: Array

    @classmethod
    def built(cls, table: CodeTable, seed: int = 0, progress: Progress = _untold) -> InvertedLists:
        """Over all rows of a table (codes alone are read, no descriptor).

        Args:
            progress: told of rows done and of all; what it raises stops the building.

        Raises:
            ValueError: the table is empty.
        """
        n = len(table)
        if not n:
            raise ValueError("there is nothing to list")
        count = min(n, int(_LISTS_PER_ROOT * np.sqrt(n)))
        generator = np.random.default_rng(seed)
        sampled = np.sort(generator.choice(n, min(n, count * _SAMPLED_PER_LIST), replace=False))
        sample = _as_signs(table.sketches_at(sampled).sketches)
        clustering = faiss.Kmeans(GROUP_BITS, count, niter=1, seed=seed, spherical=True, min_points_per_centroid=1)
        centers = None
        for _ in range(_ROUNDS):  # one by one, for in a map of a million rows each takes seconds, and may be stopped
            progress(0, n)
            clustering.train(sample, init_centroids=centers)
            centers = clustering.centroids
        empty = cls._arranged(table, np.asarray(centers, np.float32), np.empty(0, np.int64))
        return empty.extended(table, progress)

    @classmethod
    def of(cls, tensors: Mapping[str, NDArray[Any]]) -> InvertedLists:
        """From what :meth:`tensors` gave.

        Raises:
            ValueError: these are not the tensors of lists.
        """
        try:
            centers, order, ends = tensors["centers"], tensors["order"], tensors["ends"]
            sketches, scales = tensors["sketches"], tensors["scales"]
        except KeyError as error:
            raise ValueError(f"these are not the tensors of lists: {error} is missing") from error
        fitting = centers.ndim == 2 and centers.shape == (len(ends), GROUP_BITS)
        fitting = fitting and len(ends) > 0 and int(ends[-1]) == len(order) == len(sketches) == len(scales)
        if not fitting or np.any(np.diff(ends, prepend=0) < 0):
            raise ValueError("these are not the tensors of lists: their shapes do not go together")
        return cls(centers, order, ends, sketches, scales)

    def tensors(self) -> dict[str, NDArray[Any]]:
        """All that makes the lists, to be kept in a file: 76 bytes a row and 2 KB a list."""
        names = ("centers", "order", "ends", "sketches", "scales")
        return {name: getattr(self, name) for name in names}

    @property
    def rows(self) -> int:
        """Rows 0 … ``rows`` are in the lists; later ones are searched one by one until :meth:`extended`."""
        return len(self.order)

    @cached_property
    def starts(self) -> Rows:
        """Where each list begins."""
        return np.concatenate([np.zeros(1, np.int64), self.ends[:-1]])

    def extended(self, table: CodeTable, progress: Progress = _untold) -> InvertedLists:
        """With the rows that have come since, to the same centres."""
        old = np.empty(self.rows, np.int64)
        old[self.order] = np.repeat(np.arange(len(self.ends)), self.ends - self.starts)
        parts, total = [old], len(table)
        for start in range(self.rows, total, _AT_ONCE):
            stop = min(total, start + _AT_ONCE)
            parts.append(np.argmax(_as_signs(table.codes(start, stop).sketches) @ self.centers.T, axis=1))
            progress(stop, total)
        return self._arranged(table, self.centers, np.concatenate(parts))

    @classmethod
    def _arranged(cls, table: CodeTable, centers: Array, listed: Rows) -> InvertedLists:
        """Lists of rows 0 … n by the list of each, int64 [n]."""
        order = np.argsort(listed, kind="stable")
        codes = table.sketches_at(order)
        ends = np.cumsum(np.bincount(listed, minlength=len(centers)))
        return cls(centers, order, ends, codes.sketches, np.ascontiguousarray(codes.scales[:, 0]))

    def probed(self, query: CodedQuery, share: float = PROBED_SHARE) -> Rows:
        """The lists to look into, nearest first, until they hold a share of all rows; at least one."""
        nearest = np.argsort(-(self.centers @ query.principal), kind="stable")
        held = np.cumsum((self.ends - self.starts)[nearest])
        return nearest[: int(np.searchsorted(held, share * self.rows)) + 1]

    def candidates(
        self,
        table: CodeTable,
        query: CodedQuery,
        count: int,
        allowed: NDArray[np.bool_] | None = None,
        executor: Executor | None = None,
        share: float = PROBED_SHARE,
    ) -> Rows:
        """About ``count`` rows or more, those with the best sketches in the lists probed and in rows that have come
        since: ascending; fewer where the lists hold fewer that are allowed."""
        lists = self.probed(query, share)
        sizes = (self.ends - self.starts)[lists]
        found = np.concatenate([self.order[start:end] for start, end in self._spans(lists)])
        estimates = np.empty(len(found), np.float32)
        planes, step, total = query.sketch.planes, query.sketch.step, query.sketch.total

        def judge(numbers: range, into: Rows) -> None:
            for number in numbers:
                start, end = int(self.starts[lists[number]]), int(self.ends[lists[number]])
                made = estimates[into[number] : into[number] + end - start]
                estimates_of(self.sketches[start:end], self.scales[start:end], planes, step, total, made)

        offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes)])
        parts = [
            range(start, min(len(lists), start + _LISTS_PER_TASK)) for start in range(0, len(lists), _LISTS_PER_TASK)
        ]
        together([lambda part=part: judge(part, offsets) for part in parts], executor)  # type: ignore[misc]
        later = table.sketched(query, self.rows, len(table), executor=executor)
        rows = np.concatenate([found, np.arange(self.rows, len(table))])
        estimates = np.concatenate([estimates, later])
        if allowed is not None:
            estimates[~allowed[rows]] = -np.inf
        best = best_positions(estimates, count)
        return np.sort(rows[best[np.isfinite(estimates[best])]])

    def _spans(self, lists: Rows) -> list[tuple[int, int]]:
        return list(zip(self.starts[lists].tolist(), self.ends[lists].tolist(), strict=True))


def _as_signs(sketches: Bits) -> Array:
    """uint64 [n, S] as 1 and -1, float32 [n, 64 S]."""
    bits = np.unpackbits(np.ascontiguousarray(sketches).astype("<u8").view(np.uint8), axis=1, bitorder="little")
    return bits.astype(np.float32) * 2 - 1
