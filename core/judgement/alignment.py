"""Which frames of one traverse show the places of another, by sequence matching.

A single frame may resemble many places; a path of frames that resemble one place after the other does so by chance
hardly ever.  The scores of all frames of a traverse against all of another are first made comparable: the median of
each row and of each column is subtracted, and the rest divided by its spread (the median of its absolute values, as a
standard deviation), so that neither a frame that resembles everything nor a place that everything resembles counts.
What exceeds ``ORDINARY`` is the gain of a pair of frames, and what falls short of it its loss.

A path pairs consecutive frames of the first traverse with frames of the second, of which it advances by none to three
at a time; every step but that by one costs ``UNEVEN`` for each frame of difference.  The path with the largest sum is
found as in local alignment (Smith, Waterman, "Identification of common molecular subsequences", 1981), where it may
begin and end anywhere; then the next among the frames that are left.  SeqSLAM (Milford, Wyeth, 2012) sums along
straight lines instead, which holds for stretches of one pace only.

Some path is always the best.  How good it is by chance is told by the same scores with the second traverse turned
around: nobody sees its places in that order, but they resemble one another as before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

ORDINARY = 1.5
"""Deviations above the ordinary score from which on a pair of frames speaks for a path."""

LARGEST = 4.0
"""More deviations than this count as this, so that no single pair makes a path."""

UNEVEN = 0.5
"""What a step costs for each frame by which it differs from one."""

LARGEST_STEP = 3
"""A step advances by at most this many frames of the second traverse."""

LEAST_FRAMES = 10
"""A path of fewer frames is no evidence."""

BY_CHANCE = 2.0
"""A path has at least so many times the sum of the best path through the second traverse turned around."""

MOST_PATHS = 64
"""At most so many paths are looked for."""


@dataclass(frozen=True)
class SharedStretch:
    """A run of frames of one traverse that shows the places of another.

    first, second: int64 [n], numbers of the frames in the two traverses; ``first`` rises by one at a time, ``second``
        by none to three.
    gain: the mean gain of its pairs, in standard deviations.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    gain: float


def shared_stretches(scores: NDArray[np.floating]) -> list[SharedStretch]:
    """The stretches that two traverses share, best first; none if they share nothing.

    Args:
        scores: float [Q, R], finite: of each frame of the first traverse against each of the second, in the order in
            which they were taken.
    """
    if min(scores.shape) < LEAST_FRAMES:
        return []
    gains = np.minimum(comparable(scores), LARGEST) - ORDINARY
    least = BY_CHANCE * best_path(gains[:, ::-1])[1]
    found: list[SharedStretch] = []
    for _ in range(MOST_PATHS):
        path, total = best_path(gains)
        if len(path) < LEAST_FRAMES or total < least:
            break
        found.append(SharedStretch(path[:, 0], path[:, 1], total / len(path)))
        gains[path[:, 0]] = -np.inf
    return found


def comparable(scores: NDArray[np.floating]) -> Values:
    """Scores without what is ordinary for their row and their column, in standard deviations; float64 [Q, R]."""
    centred = np.asarray(scores, np.float64) - np.median(scores, axis=1, keepdims=True)
    centred -= np.median(centred, axis=0, keepdims=True)
    spread = 1.4826 * float(np.median(np.abs(centred)))  # of a normal distribution, its standard deviation
    return centred / spread if spread > 0 else centred


def best_path(gains: Values) -> tuple[NDArray[np.int64], float]:
    """The path with the largest sum of gains, int64 [n, 2] of row and column, and the sum; empty if all are losses.

    Args:
        gains: float64 [Q, R]; rows of -inf are passed by no path.
    """
    rows, columns = gains.shape
    totals, steps = np.zeros((rows, columns)), np.full((rows, columns), -1, np.int8)
    before = np.full(columns, -np.inf)
    for row in range(rows):
        reached = np.full((LARGEST_STEP + 1, columns), -np.inf)
        for step in range(LARGEST_STEP + 1):
            reached[step, step:] = before[: columns - step] - UNEVEN * abs(step - 1)
        best = reached.argmax(axis=0)
        value = reached[best, np.arange(columns)]
        goes_on = value > 0
        totals[row] = np.maximum(gains[row] + np.where(goes_on, value, 0), 0)
        steps[row] = np.where(goes_on, best, -1)
        before = np.where(totals[row] > 0, totals[row], -np.inf)
    row, column = (int(index) for index in np.unravel_index(int(totals.argmax()), totals.shape))
    total, path = float(totals[row, column]), []
    while total > 0:
        path.append((row, column))
        step = int(steps[row, column])
        if step < 0:
            break
        row, column = row - 1, column - step
    return np.array(path[::-1], np.int64).reshape(-1, 2), total
