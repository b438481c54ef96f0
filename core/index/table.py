"""The codes of a map in memory, and the search over them: sketches of all rows, full codes of the best of those."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from core.index.best_estimates import best_first, best_positions, together
from core.index.codes import CodedQuery, Coder, Codes, PlaneQuery
from core.kernels.codes import estimates_at, estimates_of

Array = NDArray[np.float32]
Rows = NDArray[np.int64]

ROWS_PER_BLOCK = 65_536
SURVIVORS = 8
"""The full code is read of this many rows for each unit of √n, and of ``FEWEST_SURVIVORS`` at least."""
FEWEST_SURVIVORS = 2048
FEW = 8
"""Where less than a row in this many is allowed, rows are picked; else all are judged and the others passed over."""
_ROWS_PER_TASK = 32_768


class Shortlist(NamedTuple):
    """rows int64 [n] and estimated inner products float32 [n], best first."""

    rows: Rows
    estimates: Array


class Block(NamedTuple):
    """Rows ``first`` … ``first + used`` of a table; behind them there may be room."""

    first: int
    used: int
    codes: Codes


class Preselection(Protocol):
    """What names the rows of a table that are worth judging, such as :class:`core.index.lists.InvertedLists`."""

    def candidates(
        self,
        table: CodeTable,
        query: CodedQuery,
        count: int,
        allowed: NDArray[np.bool_] | None = None,
        executor: Executor | None = None,
    ) -> Rows:
        """About ``count`` rows or more that are allowed, ascending; fewer where there are not as many."""
        ...


@dataclass(frozen=True, eq=False)
class CodeTable:
    """The codes of rows 0 … n of a map, an immutable value: appending gives a new one that shares its memory.

    Blocks have room behind the last row, so that a write never copies the map.  A code is never changed: a deleted
    place is left out by ``allowed``; a place whose descriptor changed has a new row.
    """

    coder: Coder
    blocks: tuple[Block, ...] = ()

    @classmethod
    def empty(cls, coder: Coder) -> CodeTable:
        """Without rows."""
        return cls(coder)

    @classmethod
    def of(cls, coder: Coder, codes: Codes) -> CodeTable:
        """Over codes as they are (mapped from a file, say), without a copy; rows appended later go elsewhere.

        Raises:
            ValueError: they are not of this coder's shape.
        """
        if (codes.sketches.shape[1], codes.bits.shape[1], codes.scales.shape[1]) != coder.shape:
            raise ValueError("these codes are of another shape than the coder's")
        return cls(coder, (Block(0, len(codes), codes),) if len(codes) else ())

    def __len__(self) -> int:
        return self.blocks[-1].first + self.blocks[-1].used if self.blocks else 0

    def appended(self, codes: Codes) -> CodeTable:
        """With further rows.  Only on the newest table, by one thread at a time."""
        blocks, done = list(self.blocks), 0
        while done < len(codes):
            if not blocks or blocks[-1].used == len(blocks[-1].codes):
                blocks.append(Block(sum(block.used for block in blocks), 0, _room(self.coder)))
            first, used, room = blocks[-1]
            count = min(len(room) - used, len(codes) - done)
            room.sketches[used : used + count] = codes.sketches[done : done + count]
            room.bits[used : used + count] = codes.bits[done : done + count]
            room.scales[used : used + count] = codes.scales[done : done + count]
            blocks[-1], done = Block(first, used + count, room), done + count
        return replace(self, blocks=tuple(blocks))

    def codes(self, start: int, stop: int) -> Codes:
        """Of rows start … stop, a copy unless they lie in one block."""
        parts = []
        for first, used, codes in self.blocks:
            rows = slice(max(0, start - first), max(0, min(used, stop - first)))
            if rows.start < rows.stop:
                parts.append((codes.sketches[rows], codes.bits[rows], codes.scales[rows]))
        if len(parts) == 1:
            return Codes(*parts[0])
        sketch, code, scales = self.coder.shape
        parts.append(
            (np.empty((0, sketch), np.uint64), np.empty((0, code), np.uint64), np.empty((0, scales), np.float32))
        )
        sketches, bits, factors = (np.concatenate([part[kind] for part in parts]) for kind in range(3))
        return Codes(sketches, bits, factors)

    def sketches_at(self, rows: Rows) -> Codes:
        """Of some rows, in their order: codes without bits."""
        sketch, _, scales = self.coder.shape
        found = Codes(
            np.empty((len(rows), sketch), np.uint64),
            np.empty((len(rows), 0), np.uint64),
            np.empty((len(rows), scales), np.float32),
        )
        for first, used, codes in self.blocks:
            at = np.flatnonzero((rows >= first) & (rows < first + used))
            found.sketches[at], found.scales[at] = codes.sketches[rows[at] - first], codes.scales[rows[at] - first]
        return found

    def shortlist(
        self,
        query: CodedQuery,
        count: int,
        allowed: NDArray[np.bool_] | None = None,
        lists: Preselection | None = None,
        executor: Executor | None = None,
    ) -> Shortlist:
        """The ``count`` rows with the highest estimates, fewer where there are not as many; equal ones by row.

        Args:
            allowed: bool [n], which rows may be returned (living and chosen by a filter); None: all.  Where few
                are allowed only their codes are read.
            lists: judge only the rows of the lists nearest to the query, and those that are in none yet.
            executor: shares the work; the calling thread takes part.  Not one whose threads call this.

        Raises:
            ValueError: ``allowed`` is not of one value a row.
        """
        n = len(self)
        if allowed is not None and allowed.shape != (n,):
            raise ValueError(f"which rows are allowed is said of all {n}")
        survivors = max(FEWEST_SURVIVORS, count, int(SURVIVORS * np.sqrt(n)))
        chosen = n if allowed is None else int(np.count_nonzero(allowed))
        if chosen <= survivors:  # the full codes of all
            rows = np.arange(n) if allowed is None else np.flatnonzero(allowed)
        elif allowed is not None and chosen * FEW < n:
            rows = np.flatnonzero(allowed)
            rows = rows[best_positions(self._sketched_at(query, rows, executor), survivors)]
        elif lists is not None:
            rows = lists.candidates(self, query, survivors, allowed, executor)
        else:
            rows = np.empty(0, np.int64)
        if len(rows) < min(survivors, chosen):  # without lists, or a filter left few of the rows that they hold
            rows = best_positions(self.sketched(query, 0, n, allowed, executor), survivors)
        estimates = self._estimated(query, rows, executor)
        best = best_first(estimates, count)
        return Shortlist(rows[best], estimates[best])

    def sketched(
        self,
        query: CodedQuery,
        start: int,
        stop: int,
        allowed: NDArray[np.bool_] | None = None,
        executor: Executor | None = None,
    ) -> Array:
        """Estimates by sketch of rows start … stop, -inf for those that are not allowed: float32 [stop - start]."""
        estimates = np.empty(stop - start, np.float32)
        planes, step, total = query.sketch.planes, query.sketch.step, query.sketch.total

        def judge(codes: Codes, begin: int, end: int, first: int) -> None:
            made = estimates[first + begin - start : first + end - start]
            estimates_of(codes.sketches[begin:end], codes.scales[begin:end, 0], planes, step, total, made)
            if allowed is not None:
                made[~allowed[first + begin : first + end]] = -np.inf

        tasks = [
            _task(judge, codes, begin, min(used, stop - first, begin + _ROWS_PER_TASK), first)
            for first, used, codes in self.blocks
            for begin in range(max(0, start - first), min(used, stop - first), _ROWS_PER_TASK)
        ]
        together(tasks, executor)
        return estimates

    def _sketched_at(self, query: CodedQuery, rows: Rows, executor: Executor | None) -> Array:
        """Estimates by sketch of some rows, ascending."""
        return self._estimates_at(query.sketch, lambda codes: (codes.sketches, codes.scales[:, 0]), rows, executor)

    def _estimated(self, query: CodedQuery, rows: Rows, executor: Executor | None) -> Array:
        """Estimates by the full codes of some rows, ascending."""
        return self._estimates_at(query.code, lambda codes: (codes.bits, codes.scales[:, 1]), rows, executor)

    def _estimates_at(
        self,
        query: PlaneQuery,
        signs_and_scales: Callable[[Codes], tuple[NDArray[np.uint64], Array]],
        rows: Rows,
        executor: Executor | None,
    ) -> Array:
        """Estimates of some rows, ascending, by one kind of their codes."""
        estimates = np.empty(len(rows), np.float32)

        def judge(codes: Codes, start: int, stop: int, first: int) -> None:
            at = rows[start:stop] - first
            estimates_at(*signs_and_scales(codes), query.planes, query.step, query.total, at, estimates[start:stop])

        together(self._tasks_at(judge, rows), executor)
        return estimates

    def _tasks_at(self, judge: Callable[[Codes, int, int, int], None], rows: Rows) -> list[Callable[[], None]]:
        """``judge`` for the rows of each block, in parts of at most a thousand."""
        tasks: list[Callable[[], None]] = []
        for first, used, codes in self.blocks:
            start, stop = np.searchsorted(rows, [first, first + used]).tolist()
            tasks += [_task(judge, codes, begin, min(stop, begin + 1024), first) for begin in range(start, stop, 1024)]
        return tasks


def _task(
    judge: Callable[[Codes, int, int, int], None], codes: Codes, start: int, stop: int, first: int
) -> Callable[[], None]:
    return lambda: judge(codes, start, stop, first)


def _room(coder: Coder) -> Codes:
    """A block of rows to be filled; memory is taken by the system as they are."""
    sketch, code, scales = coder.shape
    return Codes(
        np.empty((ROWS_PER_BLOCK, sketch), np.uint64),
        np.empty((ROWS_PER_BLOCK, code), np.uint64),
        np.empty((ROWS_PER_BLOCK, scales), np.float32),
    )
