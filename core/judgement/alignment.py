"""Which frames of one traverse show the places of another, by sequence matching.

A single frame may resemble many places; a path of frames that resemble one place after the other does so by chance
hardly ever.  The scores of all frames of a traverse against all of another are first made comparable: the median of
each row and of each column is subtracted, and the rest divided by its spread (the median of its absolute values, as a
standard deviation), so that neither a frame that resembles everything nor a place that everything resembles counts.
The excess over ``ORDINARY`` is the gain of a pair of frames, and the deficit its loss.

A path pairs consecutive frames of the first traverse with frames of the second, of which it advances by none to three
at a time; every step but that by one costs ``UNEVEN`` for each frame of difference.  The path with the largest sum is
found as in local alignment (Smith, Waterman, "Identification of common molecular subsequences", 1981), where it may
begin and end anywhere; then the next among the frames that are left.  SeqSLAM (Milford, Wyeth, 2012) sums along
straight lines instead, which holds for stretches of one pace only.

Some path is always the best.  Its quality by chance is measured on the same scores with the second traverse turned
around: nobody sees its places in that order, but they resemble one another as before.

Memory does not grow with the product of the lengths: scores are computed in tiles, of each frame the ``MOST_PAIRS``
best pairs are stored, all others count as ordinary ones, and of a long traverse ``TOGETHER`` frames are matched at a
time.  Time does grow with the product, by an inner product of two descriptors for each pair of frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.kernels import paths as kernels

Values = NDArray[np.float64]
Frames = NDArray[np.int64]

Scores = Callable[[Frames], Callable[[Frames], NDArray[np.floating]]]
"""The scores of some frames of the first traverse, int64 [q]: a function that returns float [q, r], finite, for frames
of the second, int64 [r]."""

ORDINARY = 1.5
"""Deviations above the ordinary score from which on a pair of frames speaks for a path."""

LARGEST = 4.0
"""More deviations than this count as this, so that no single pair makes a path."""

UNEVEN = 0.5
"""The cost of a step for each frame by which it differs from one."""

LARGEST_STEP = 3
"""A step advances by at most this many frames of the second traverse."""

LEAST_FRAMES = 10
"""A path of fewer frames is no evidence."""

BY_CHANCE = 2.0
"""The least ratio of a path's sum to that of the best path through the second traverse turned around."""

MOST_PATHS = 64
"""The largest number of paths looked for among the frames that are matched together."""

TOGETHER = 1024
"""The largest number of frames of the first traverse that are matched at a time; a path ends with them."""

TILE = 512
"""Number of frames of the second traverse that are scored at a time."""

MOST_PAIRS = 512
"""The largest number of pairs that are stored for each frame of the first traverse."""

SAMPLE = 1024
"""The largest number of frames of the second traverse from which the median of a row and the spread are estimated."""


@dataclass(frozen=True)
class SharedStretch:
    """A run of frames of one traverse that shows the places of another.

    first, second: int64 [n], numbers of the frames in the two traverses; ``first`` rises by one at a time, ``second``
        by none to three.
    gain: the mean gain of its pairs, in standard deviations.
    """

    first: Frames
    second: Frames
    gain: float

    @property
    def total(self) -> float:
        """The sum of its gains: how much speaks for it."""
        return self.gain * len(self.first)


def shared_stretches(
    scores: Scores, first: int, second: int, advance: Callable[[int], None] = lambda pairs: None
) -> list[SharedStretch]:
    """The stretches that two traverses share, best first; none if they share nothing or have fewer than ten frames.

    Args:
        scores: of frames of the first traverse against frames of the second; frames are numbered from 0 in the order
            in which they were taken.
        first, second: how many frames the traverses have; the first may have at most ``LARGEST_STEP`` times fewer
            frames of the same way.
        advance: called with the number of pairs of frames scored since the last call; its exceptions end the search.
    """
    if min(first, second) < LEAST_FRAMES:
        return []
    found: list[SharedStretch] = []
    for rows in np.array_split(np.arange(first), -(-first // TOGETHER)):
        pairs = best_pairs(scores(rows), len(rows), second, advance)
        found += [replace(one, first=rows[one.first]) for one in _stretches(pairs)]
    return sorted(found, key=lambda one: -one.total)


def of_matrix(scores: NDArray[np.floating]) -> Scores:
    """The scores of two traverses that are all known, float [Q, R]."""
    return lambda rows: lambda columns: scores[np.ix_(rows, columns)]


@dataclass(frozen=True)
class AlignedPairs:
    """The pairs of Q frames with R others that speak for a path most.

    columns: int64 [Q, K], the other frame of each pair, ascending in each row.
    gains: float64 [Q, K]; a pair that is not there has a gain of -ORDINARY, that of an ordinary score.
    others: R.
    free: bool [Q], the rows that paths may pass.
    """

    columns: Frames
    gains: Values
    others: int
    free: NDArray[np.bool_]

    def turned_around(self) -> AlignedPairs:
        """The same pairs with the others in the opposite order."""
        return replace(self, columns=self.others - 1 - self.columns[:, ::-1], gains=self.gains[:, ::-1])

    def without(self, rows: Frames) -> AlignedPairs:
        """The pairs without those of some rows."""
        free = self.free.copy()
        free[rows] = False
        return replace(self, free=free)


def best_pairs(
    scores: Callable[[Frames], NDArray[np.floating]],
    rows: int,
    others: int,
    advance: Callable[[int], None] = lambda pairs: None,
) -> AlignedPairs:
    """Of each of some rows the best pairs by comparable scores.

    Args:
        scores: of the rows at some columns, int64 [r]: float [rows, r].
        others: the number of columns.
        advance: as of :func:`shared_stretches`.
    """
    sample = np.unique(np.linspace(0, others - 1, min(others, SAMPLE)).astype(np.int64))
    sampled = np.asarray(scores(sample), np.float32)
    ordinary = np.median(sampled, axis=1, keepdims=True)
    centred = sampled - ordinary
    centred -= np.median(centred, axis=0, keepdims=True)
    spread = 1.4826 * float(np.median(np.abs(centred)))  # of a normal distribution, its standard deviation
    columns = np.empty((rows, 0), np.int64)
    gains = np.empty((rows, 0), np.float32)
    for start in range(0, others, TILE):
        tile = np.arange(start, min(start + TILE, others))
        found = np.asarray(scores(tile), np.float32) - ordinary
        found -= np.median(found, axis=0, keepdims=True)
        found = np.minimum(found / spread if spread > 0 else found, LARGEST) - ORDINARY
        columns = np.concatenate([columns, np.broadcast_to(tile, found.shape)], axis=1)
        gains = np.concatenate([gains, found], axis=1)
        if gains.shape[1] > MOST_PAIRS:
            best = np.sort(np.argpartition(-gains, MOST_PAIRS, axis=1)[:, :MOST_PAIRS], axis=1)
            columns = np.take_along_axis(columns, best, axis=1)
            gains = np.take_along_axis(gains, best, axis=1)
        advance(found.size)
    return AlignedPairs(columns, gains.astype(np.float64), others, np.ones(rows, np.bool_))


def _stretches(pairs: AlignedPairs) -> Iterator[SharedStretch]:
    """The paths that are better than by chance, best first."""
    least = BY_CHANCE * best_path(pairs.turned_around())[1]
    for _ in range(MOST_PATHS):
        path, total = best_path(pairs)
        if len(path) < LEAST_FRAMES or total < least:
            break
        yield SharedStretch(path[:, 0], path[:, 1], total / len(path))
        pairs = pairs.without(path[:, 0])


def best_path(pairs: AlignedPairs) -> tuple[Frames, float]:
    """The path with the largest sum of gains, int64 [n, 2] of row and column, and the sum; empty if all are losses.

    A path goes through columns where its sum is positive; of each row only these are remembered.
    """
    uneven = UNEVEN * np.abs(np.arange(LARGEST_STEP + 1) - 1.0)
    columns, gains = np.ascontiguousarray(pairs.columns), np.ascontiguousarray(pairs.gains)
    path, total = kernels.best_path(columns, gains, pairs.free, pairs.others, ORDINARY, uneven, _BEGINS)
    return path, float(total)


def best_path_by_rows(pairs: AlignedPairs) -> tuple[Frames, float]:
    """:func:`best_path` in NumPy."""
    columns, totals = np.empty(0, np.int64), np.empty(0)
    reached: list[tuple[Frames, NDArray[np.int8]]] = []
    best, end = 0.0, (-1, -1)
    for row in range(len(pairs.columns)):
        columns, totals, steps = _row(pairs, row, columns, totals)
        reached.append((columns, steps))
        if len(totals) and totals.max() > best:
            best, end = float(totals.max()), (row, int(columns[totals.argmax()]))
    path = []
    row, column = end
    while row >= 0:
        path.append((row, column))
        columns, steps = reached[row]
        step = int(steps[np.searchsorted(columns, column)])
        if step == _BEGINS:
            break
        row, column = row - 1, column - step
    return np.array(path[::-1], np.int64).reshape(-1, 2), best


_BEGINS = -1
"""The step of a path's first pair."""


def _row(pairs: AlignedPairs, row: int, before: Frames, totals: Values) -> tuple[Frames, Values, NDArray[np.int8]]:
    """The columns of a row at which a path may be, its sum, and by which step it came, given those of the row before.

    Returns:
        Columns int64 [k], ascending, sums float64 [k] over 0, and steps int8 [k].
    """
    if not pairs.free[row]:
        return np.empty(0, np.int64), np.empty(0), np.empty(0, np.int8)
    own = pairs.columns[row]
    columns = np.concatenate([own, *(before + step for step in range(LARGEST_STEP + 1))])
    sums = np.concatenate([
        np.zeros(len(own)), *(totals - UNEVEN * abs(step - 1) for step in range(LARGEST_STEP + 1))
    ])  # fmt: skip
    steps = np.repeat(
        np.arange(_BEGINS, LARGEST_STEP + 1, dtype=np.int8), [len(own)] + [len(before)] * (LARGEST_STEP + 1)
    )
    there = (sums >= 0) & (columns < pairs.others)
    columns, sums, steps = columns[there], sums[there], steps[there]
    order = np.lexsort((-sums, columns))
    order = order[np.diff(columns[order], prepend=-1) > 0]  # the best way to each column
    columns, sums, steps = columns[order], sums[order], steps[order]
    gains = np.full(len(columns), -ORDINARY)
    gains[np.searchsorted(columns, own)] = pairs.gains[row]
    sums += gains
    good = sums > 0
    return columns[good], sums[good], steps[good]
