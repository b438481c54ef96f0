"""Pairs of views of two neighbouring frames of one walk or drive, and which cells of the two show the same spot.

Between such frames the camera has moved on, as it has between traverses and not between two views of one photograph.
Cells that show the same are found by the third stage: the keypoints of the undisturbed views are matched, and a match
that fits the geometry says which cells answer each other.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.geometry.detection import find_keypoints
from core.geometry.verification import Verification, verify
from core.networks.xfeat import load_xfeat
from lab.training.photographs import read, split_photographs
from lab.training.views.augmentation import augment
from lab.training.views.displaced_views import (
    COLUMNS,
    DISTURBED,
    FIRST_CELL,
    STRIDE,
    DisplacedViews,
    Displacement,
    displaced,
)

WALKS = ("camvid", "tower")
"""Sources whose photographs are frames of walks and drives, numbered as they were taken."""
LEAST_INLIERS, LEAST_EVIDENCE = 15, 5.0
"""Of the keypoints of two views whose geometry is believed."""


def neighbouring_views(photographs: Path, side: int, count: int, seed: int) -> Iterator[DisplacedViews]:
    """Draw pairs from the training photographs and give those whose geometry is believed.

    The same seed draws the same ones.  There are none without walks.
    """
    paths = split_photographs(photographs).train
    runs: dict[tuple[Path, str], list[tuple[int, int]]] = {}
    for number, path in enumerate(paths):
        numbered = re.fullmatch(r"(.*?)(\d+)", path.stem)
        if numbered and path.relative_to(photographs).parts[0] in WALKS:
            runs.setdefault((path.parent, numbered[1]), []).append((int(numbered[2]), number))
    pairs = [(one, other) for run in runs.values() for (_, one), (_, other) in pairwise(sorted(run))]
    if not pairs:
        return
    network, generator = load_xfeat(), np.random.default_rng(seed)
    for _ in range(count):
        chosen = generator.permutation(pairs[int(generator.integers(len(pairs)))]).tolist()
        first, second, _ = displaced([read(paths[one]) for one in chosen], side, generator)
        shown, queried = find_keypoints(network, first), find_keypoints(network, second)
        found = verify(queried, [shown])[0]
        if found.inlier_count >= LEAST_INLIERS and found.evidence > LEAST_EVIDENCE:
            answers = matched_cells(found, shown.shares(), queried.shares(), side)
            if generator.random() < DISTURBED:
                second = augment(second, generator)
            yield DisplacedViews(first, second, Displacement(answers, chosen[0], "neighbours", ""))


def matched_cells(
    found: Verification, first: NDArray[np.floating], second: NDArray[np.floating], side: int
) -> NDArray[np.int64]:
    """The cells of two views that a match of keypoints which fits joins, those of the first once; int64 [n, 2].

    Of several matches from one cell, that counts which is nearest to the middles of its cells.

    Args:
        found: the verification of the second view as the query and the first as the candidate.
        first, second: where the keypoints are, as shares of the views' sides, float [k, 2].
        side: of the views, in pixels.
    """
    inliers = found.matches[found.inliers]
    cells, apart = [], np.zeros(len(inliers))
    for shares, column in ((first, 1), (second, 0)):
        place = (shares[inliers[:, column]] * side - FIRST_CELL) / STRIDE
        nearest = np.rint(place).astype(np.int64)
        apart += np.abs(place - nearest).max(axis=1, initial=0)
        apart[((nearest < 0) | (nearest >= COLUMNS)).any(axis=1)] = np.inf
        cells.append(nearest[:, 1] * COLUMNS + nearest[:, 0])
    order = np.argsort(apart, kind="stable")
    order = order[apart[order] < np.inf]
    _, once = np.unique(cells[0][order], return_index=True)
    return np.stack(cells, axis=1)[order[once]]
