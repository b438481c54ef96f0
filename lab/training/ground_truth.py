"""Corrects the ground truth of a pair of traverses: which reference each query really shows, by local features alone.

The truth that comes with eval/lip6_outdoor assumes that both loops were walked at one pace; they were not, so it
drifts by up to nine frames from what the pictures show.  Here each query is compared with the references around its
stated one by the number of SIFT matches (Lowe, 2004) that pass the ratio test, and the path with the most matches is
taken along which the shift against the stated truth changes by at most one frame a step.  No network of this project
takes part, so encoders can be compared by it.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels

REACH = 20
"""Frames around the stated reference within which the true one is searched."""
RATIO = 0.8
"""Lowe's ratio of the distances to the nearest and to the second nearest feature."""
TOLERANCE = 2
SMOOTHNESS = 0.05
"""The cost of a change of shift by one frame, as a share of a query's best number of matches."""


def local_features(pixels: Pixels) -> NDArray[np.float32]:
    """SIFT descriptors of a frame enlarged twice, float32 [n, 128]."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    enlarged = cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    found = cv2.SIFT_create(500, contrastThreshold=0.02).detectAndCompute(enlarged, None)[1]  # type: ignore[attr-defined]
    return np.zeros((0, 128), np.float32) if found is None else np.asarray(found, np.float32)


def match_count(a: NDArray[np.float32], b: NDArray[np.float32]) -> int:
    """How many features of ``a`` pass the ratio test against ``b``."""
    if len(a) == 0 or len(b) < 2:
        return 0
    products = a @ b.T
    squared = (a * a).sum(1)[:, None] + (b * b).sum(1)[None] - 2 * products
    nearest = np.partition(np.maximum(squared, 1e-3), 1, axis=1)[:, :2]  # equal features are not separated by rounding
    return int((nearest[:, 0] < RATIO**2 * nearest[:, 1]).sum())


def smooth_path(support: NDArray[np.float32]) -> NDArray[np.int64]:
    """The path with the most support that moves by at most one column a row (Viterbi), as columns, int64 [n]."""
    rows, columns = support.shape
    total, came = support[0].astype(np.float64), np.zeros((rows, columns), np.int64)
    moves = np.array([-1, 0, 1])
    for row in range(1, rows):
        padded = np.pad(total, 1, constant_values=-np.inf)
        offered = np.stack([padded[1 + move : 1 + move + columns] - SMOOTHNESS * abs(move) for move in moves])
        chosen = offered.argmax(axis=0)
        came[row] = np.arange(columns) + moves[chosen]
        total = offered.max(axis=0) + support[row]
    path = np.empty(rows, np.int64)
    path[-1] = total.argmax()
    for row in range(rows - 1, 0, -1):
        path[row - 1] = came[row, path[row]]
    return path


def corrected_truth(
    queries: Sequence[Pixels], references: Sequence[Pixels], stated: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The corrected truth: bool [Q, R], references within TOLERANCE of the path with the most matches.

    Args:
        stated: bool [Q, R]; each query's true references form one run of indices or several, of which each is
            followed as a pass of its own.
    """
    queried = [local_features(frame) for frame in queries]
    known = [local_features(frame) for frame in references]
    truth = np.zeros_like(stated)
    for first, centres in passes(stated):
        support = np.zeros((len(centres), 2 * REACH + 1), np.float32)
        for row, centre in enumerate(centres):
            for column in range(2 * REACH + 1):
                reference = centre + column - REACH
                if 0 <= reference < len(references):
                    support[row, column] = match_count(queried[first + row], known[reference])
        support /= np.maximum(support.max(axis=1, keepdims=True), 1)
        for row, shift in enumerate(smooth_path(support) - REACH):
            centre = int(centres[row] + shift)
            truth[first + row, max(0, centre - TOLERANCE) : max(0, centre + TOLERANCE + 1)] = True
    return truth


def passes(stated: NDArray[np.bool_]) -> list[tuple[int, NDArray[np.int64]]]:
    """Each pass through the references: its first query, and the middle reference of each of its queries."""
    open_passes: list[tuple[int, list[int]]] = []
    closed: list[tuple[int, list[int]]] = []
    for query, row in enumerate(stated):
        true = np.flatnonzero(row)
        runs = np.split(true, np.flatnonzero(np.diff(true) > 1) + 1) if len(true) else []
        centres = [int(run[len(run) // 2]) for run in runs]
        still_open = []
        for first, middle in open_passes:
            following = [centre for centre in centres if abs(centre - middle[-1]) <= 3]
            if following:
                middle.append(following[0])
                centres.remove(following[0])
                still_open.append((first, middle))
            else:
                closed.append((first, middle))
        open_passes = still_open + [(query, [centre]) for centre in centres]
    return [(first, np.array(middle, np.int64)) for first, middle in closed + open_passes]
