"""Geometric verification: which matches of two pictures' keypoints fit one rigid scene, and whether by chance.

Two keypoints match if each is the other's nearest neighbour by the cosine of their descriptors.  If both pictures show
one rigid scene, the matches x, x' fit a fundamental matrix, x'^T F x = 0; a robust estimator finds the one that most of
them fit, its inliers.

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

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from core.geometry.detection import LONGEST_SIDE
from core.geometry.keypoints import RESOLUTION, Keypoints
from core.threads import each

LEAST_COSINE = 0.75
"""Of two descriptors that can match."""
THRESHOLD = 1.5
"""Pixels by which an inlier may miss its epipolar line, where the longer side of the picture is LONGEST_SIDE."""
CONFIDENCE, ITERATIONS = 0.999, 300
LEAST_MATCHES = 8
"""Seven matches determine a fundamental matrix, so they say nothing about it."""
GRID = 8
"""Rows and columns of the cells over which the spread of inliers is counted."""


@dataclass(frozen=True)
class Verification:
    """What the geometry of a query and a candidate says.

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


def verify(query: Keypoints, candidates: Sequence[Keypoints]) -> list[Verification]:
    """Verify each candidate of a query; the same input gives the same result.

    The candidates are shared out among as many threads as torch has in the calling thread.
    """
    asked = query.descriptors.astype(np.float32)
    shown = _points(query)
    return each(lambda candidate: _verify(query, asked, shown, candidate), candidates, torch.get_num_threads())


def mutual_matches(query: NDArray[np.float32], candidate: NDArray[np.float32]) -> NDArray[np.int64]:
    """The mutual nearest neighbours of quantized descriptors whose cosine is over LEAST_COSINE.

    Products of whole numbers are exact in float32 here: 64 · 127² < 2^24.  So every processor finds the same matches.

    Args:
        query, candidate: float32 [n, 64] and [m, 64], whole numbers from -127 to 127.

    Returns:
        int64 [k, 2], numbers of the query's and of the candidate's, ascending in the query's; ties to the lower one.
    """
    if not len(query) or not len(candidate):
        return np.zeros((0, 2), np.int64)
    products = query @ candidate.T
    there, back = products.argmax(axis=1), products.argmax(axis=0)
    numbers = np.arange(len(query))
    chosen = (back[there] == numbers) & (products[numbers, there] > LEAST_COSINE * RESOLUTION**2)
    return np.stack([numbers[chosen], there[chosen]], axis=1)


def fitting(query: NDArray[np.float64], candidate: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which matches fit the fundamental matrix that most of them fit, by MAGSAC++ (Barath et al., CVPR 2020).

    Args:
        query, candidate: float64 [m, 2], positions in pixels; finite.

    Returns:
        bool [m]; none where no fundamental matrix is found, as for fewer than eight matches.
    """
    none = np.zeros(len(query), np.bool_)
    if len(query) < LEAST_MATCHES:
        return none
    try:
        # Its random numbers start with the same seed at each call.
        _, inliers = cv2.findFundamentalMat(query, candidate, cv2.USAC_MAGSAC, THRESHOLD, CONFIDENCE, ITERATIONS)
    except cv2.error:  # of some degenerate matches
        return none
    return none if inliers is None else np.asarray(inliers).ravel().astype(np.bool_)


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


def _verify(
    query: Keypoints, asked: NDArray[np.float32], shown: NDArray[np.float64], candidate: Keypoints
) -> Verification:
    matches = mutual_matches(asked, candidate.descriptors.astype(np.float32))
    ours, theirs = shown[matches[:, 0]], _points(candidate)[matches[:, 1]]
    inliers = fitting(ours, theirs)
    chance = max(_chance(query), _chance(candidate))
    cells = query.positions[matches[inliers, 0]].astype(np.int64) * GRID >> 16
    spread = len(np.unique(cells[:, 1] * GRID + cells[:, 0])) / GRID**2
    found = evidence(len(matches), int(inliers.sum()), chance)
    return Verification((len(query), len(candidate)), matches, inliers, found, spread)


def _points(keypoints: Keypoints) -> NDArray[np.float64]:
    """Positions in pixels of the frame with a longer side of LONGEST_SIDE."""
    return keypoints.pixels() * (LONGEST_SIDE / max(keypoints.width, keypoints.height))


def _chance(keypoints: Keypoints) -> float:
    """The share of a picture that lies within the threshold of its longest line."""
    scale = LONGEST_SIDE / max(keypoints.width, keypoints.height)
    width, height = keypoints.width * scale, keypoints.height * scale
    return min(0.5, 2 * THRESHOLD * hypot(width, height) / (width * height))
