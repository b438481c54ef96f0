"""Geometric verification: which matches of two pictures' keypoints fit one rigid scene, and whether by chance.

If both pictures show one rigid scene, the matches x, x' of their keypoints (``matching.py``) fit a fundamental matrix,
x'^T F x = 0.  Compiled loops (``core.kernels.epipolar``) find the one that most of them fit; these are its inliers.

A camera that stands or only turns, and a scene that is a plane, leave F open: x' ~ H x with one homography H, and each
F = [e]x H fits, for any epipole e (Hartley and Zisserman, Multiple View Geometry, section 11.9).  Any of them will do
here.

Matches that lie on one line in a picture, as lamps at night may, fit F = l' l^T with any other picture: all
points of the one line go with all points of the other picture.  Such a matrix says nothing and has no inliers.

A few inliers come by chance, the more the more matches there are.  How surprising k inliers of m matches are is said by
the number of false alarms of Moisan and Stival ("A probabilistic criterion to detect rigid point matches between two
images and estimate the fundamental matrix", IJCV 2004),

    NFA = 3 (m - 7) C(m, k) C(k, 7) α^(k - 7),

which bounds how many fundamental matrices with so many inliers one expects of unrelated pictures.  α is the chance that
a point lies within the threshold of an epipolar line.  The evidence is -ln NFA, or 0 where that is negative: a picture
that could give little gives little evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb, hypot, log

import numpy as np
from numpy.typing import NDArray

from core.geometry.detection import shown_scale
from core.geometry.keypoints import Keypoints
from core.geometry.matching import neighbors_among
from core.kernels.epipolar import fitting_neighbors
from core.threads import allowed_threads, each

THRESHOLD = 1.0
"""Pixels by which an inlier may miss its epipolar line, of the picture as the network of keypoints sees it."""
CERTAINTY, DRAWS = 0.999, 250
"""With so many draws, recall@1 on tasks of all kinds is that of MAGSAC++ with a hundred (Barath et al., CVPR 2020), in
a third of the time (``python -m benchmarks.geometry.cost``); more draws gain nothing."""
LEAST_MATCHES = 8
"""Seven matches determine a fundamental matrix, so they say nothing about it."""
GRID = 8
"""Rows and columns of the cells over which the spread of inliers is counted."""


@dataclass(frozen=True)
class Verification:
    """The geometric evidence for a query and a candidate.

    keypoints: how many the query and the candidate have.
    matches: int64 [m, 2], numbers of the query's and of the candidate's keypoints; ascending in the query's.
    inliers: bool [m], the matches that fit one fundamental matrix; none for fewer than eight matches.
    evidence: -ln of the number of false alarms, at least 0.
    spread: the share of an 8 x 8 grid over the query in which there are inliers, in [0, 1].
    """

    keypoints: tuple[int, int]
    matches: NDArray[np.int64]
    inliers: NDArray[np.bool_]
    evidence: float
    spread: float

    @property
    def inlier_count(self) -> int:
        """How many matches fit."""
        return int(self.inliers.sum())

    @property
    def inlier_share(self) -> float:
        """Inliers by the number of keypoints of the picture that has fewer, in [0, 1]."""
        return self.inlier_count / max(1, min(self.keypoints))


def verify(query: Keypoints, candidates: Sequence[Keypoints]) -> list[Verification]:
    """Verify each candidate of a query; the same input gives the same result.

    The candidates are shared out among as many threads as the calling thread may use.
    """
    if not candidates:
        return []
    parts = min(allowed_threads(), len(candidates))
    found = each(lambda part: _verified(query, candidates[part::parts]), range(parts), parts)
    return [found[number % parts][number // parts] for number in range(len(candidates))]


def fitting(query: NDArray[np.float64], candidate: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which matches fit the fundamental matrix that most of them fit; the same matches always give the same answer.

    Args:
        query, candidate: float64 [m, 2], positions in pixels; finite.

    Returns:
        bool [m]; none for fewer than eight matches, or where half of those that fit do so only because they are on one
        line.
    """
    neighbors = np.arange(len(query), dtype=np.int32)[None]
    (fits,) = fitting_neighbors(neighbors, query, candidate[None], THRESHOLD, DRAWS, CERTAINTY)
    return np.asarray(fits, np.bool_)


def evidence(matches: int, inliers: int, chance: float) -> float:
    """-ln of the number of false alarms (Moisan and Stival, 2004), or 0 where that is negative.

    Args:
        matches: m.
        inliers: k <= m.
        chance: α, that an unrelated point lies within the threshold of an epipolar line.
    """
    if inliers < LEAST_MATCHES:
        return 0.0
    choices = 3 * (matches - 7) * comb(matches, inliers) * comb(inliers, 7)
    return max(0.0, -(log(choices) + (inliers - 7) * log(chance)))


def _verified(query: Keypoints, candidates: Sequence[Keypoints]) -> list[Verification]:
    """Verify each candidate, in the calling thread; almost all of it is compiled, and needs no interpreter."""
    neighbors = neighbors_among(query, candidates)
    theirs = np.zeros((len(candidates), max(map(len, candidates)), 2))
    for made, one in zip(theirs, candidates, strict=True):
        made[: len(one)] = points_of(one)
    fits = fitting_neighbors(neighbors, points_of(query), theirs, THRESHOLD, DRAWS, CERTAINTY)
    squares = query.positions.astype(np.int64) * GRID >> 16
    cells = squares[:, 1] * GRID + squares[:, 0]
    found = []
    for there, fit, candidate in zip(neighbors, fits, candidates, strict=True):
        matched = np.flatnonzero(there >= 0)
        inliers = fit[matched]
        chance = max(chance_of(query), chance_of(candidate))
        rated = evidence(len(matched), int(inliers.sum()), chance)
        spread = len(np.unique(cells[fit])) / GRID**2
        matches = np.stack([matched, there[matched]], axis=1)
        found.append(Verification((len(query), len(candidate)), matches, inliers, rated, spread))
    return found


def points_of(keypoints: Keypoints) -> NDArray[np.float64]:
    """Positions in pixels of the frame as the network sees it, float64 [n, 2]."""
    return keypoints.pixels() * shown_scale(keypoints.width, keypoints.height)


def chance_of(keypoints: Keypoints) -> float:
    """α, the share of a picture that lies within the threshold of its longest line."""
    scale = shown_scale(keypoints.width, keypoints.height)
    width, height = keypoints.width * scale, keypoints.height * scale
    return min(0.5, 2 * THRESHOLD * hypot(width, height) / (width * height))
