"""Geometric verification: which matches of two pictures' keypoints fit one rigid scene, and whether by chance.

If both pictures show one rigid scene, the matches x, x' of their keypoints (``matching.py``) fit a fundamental matrix,
x'^T F x = 0; a robust estimator finds the one that most of them fit, its inliers.

A camera that stands or only turns, and a scene that is a plane, leave F open: x' ~ H x with one homography H, and each
F = [e]x H fits, for any epipole e (Hartley and Zisserman, Multiple View Geometry, section 11.9).  The estimator,
which throws such samples away as degenerate, may find nothing then, in a frame and itself too.  So a homography is
estimated beside it, and those are the inliers of which there are more.

Matches that lie on one line in a picture, as lamps at night may, fit F = l' l^T with any other picture: all
points of the one line go with all points of the other picture.  Such a matrix says nothing and has no inliers.

A few inliers come by chance, the more the more matches there are.  How surprising k inliers of m matches are is said by
the number of false alarms of Moisan and Stival ("A probabilistic criterion to detect rigid point matches between two
images and estimate the fundamental matrix", IJCV 2004),

    NFA = 3 (m - 7) C(m, k) C(k, 7) α^(k - 7),

which bounds how many fundamental matrices with so many inliers one expects of unrelated pictures.  α is the chance that
a point lies within the threshold of an epipolar line.  The evidence is -ln NFA, or 0 where that is negative: a picture
that could give little gives little evidence.

Inliers of a homography are counted by the same formula, since they fit a fundamental matrix as well.  Homographies have
a number of their own, (m - 4) C(m, k) C(k, 4) β^(k - 4), in which β is the chance that a point lies within the
threshold of another (Moisan, Moulon and Monasse, "Automatic homographic registration of a pair of images", IPOL 2012).
As β is smaller, so is that number: the evidence here is the cautious one.  By the other, a wall that strangers share
would say more than as many inliers in a scene with depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import comb, hypot, log

import cv2
import numpy as np
from numpy.typing import NDArray

from core.geometry.detection import shown_scale
from core.geometry.keypoints import Keypoints
from core.geometry.matching import mutual_matches
from core.threads import allowed_threads, each

THRESHOLD = 1.0
"""Pixels by which an inlier may miss its epipolar line, of the picture as the network of keypoints sees it."""
CONFIDENCE, ITERATIONS = 0.999, 100
"""They find a homography that half of the matches fit in 998 of 1000 cases.  Three times as many take twice the time
for a fundamental matrix, and tell places apart no better.  With sixty, or without the refinement of MAGSAC++, which
takes half of the time, recall@1 is 0.01 lower in whole and in halved maps."""
ENOUGH = 0.5
"""The share of matches that fit a fundamental matrix from which on no homography is sought.  Of 1 594 pairs of eight
tasks none had a homography with more inliers; views that are shown again have, where the matrix has hardly any."""
PLANE_THRESHOLD = 2 * THRESHOLD
"""Pixels by which an inlier of a homography may miss its point, in two directions in place of one."""
LEAST_MATCHES = 8
"""Seven matches determine a fundamental matrix, so they say nothing about it."""
GRID = 8
"""Rows and columns of the cells over which the spread of inliers is counted."""


@dataclass(frozen=True)
class Verification:
    """The geometric evidence for a query and a candidate.

    keypoints: how many the query and the candidate have.
    matches: int64 [m, 2], numbers of the query's and of the candidate's keypoints; ascending in the query's.
    inliers: bool [m], the matches that fit one fundamental matrix or one homography; none for fewer than eight matches.
    evidence: -ln of the number of false alarms, at least 0.
    spread: the share of an 8 x 8 grid over the query in which there are inliers, in [0, 1].
    """

    keypoints: tuple[int, int]
    matches: NDArray[np.int64]
    inliers: NDArray[np.bool_]
    evidence: float
    spread: float

    @property
    def match_share(self) -> float:
        """Matches by the number of keypoints of the picture that has fewer, in [0, 1]."""
        return len(self.matches) / max(1, min(self.keypoints))

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
    found = verify_promising(query, candidates, [0.0] * len(candidates))
    return [one for one in found if one is not None]


def verify_promising(
    query: Keypoints, candidates: Sequence[Keypoints], least: Sequence[float]
) -> list[Verification | None]:
    """Verify each candidate of a query that has enough matches; matching takes a third of the time of the whole.

    Args:
        least: of each candidate the share of matches, by the keypoints of the picture that has fewer, that are enough.

    Returns:
        None for a candidate that has fewer.
    """
    queried = query.descriptors.astype(np.float32)
    shown = points_of(query)

    def verified(asked: tuple[Keypoints, float]) -> Verification | None:
        return _verify(query, queried, shown, *asked)

    return each(verified, list(zip(candidates, least, strict=True)), allowed_threads())


def fitting(query: NDArray[np.float64], candidate: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which matches fit the fundamental matrix or the homography that most of them fit.

    Both are found by MAGSAC++ (Barath et al., CVPR 2020).

    Args:
        query, candidate: float64 [m, 2], positions in pixels; finite.

    Returns:
        bool [m]; none where neither is found, as for fewer than eight matches.
    """
    if len(query) < LEAST_MATCHES:
        return np.zeros(len(query), np.bool_)
    scene = fitting_scene(query, candidate)
    if scene.sum() >= ENOUGH * len(scene):
        return scene
    plane = fitting_plane(query, candidate)
    return plane if plane.sum() > scene.sum() else scene


def fitting_scene(query: NDArray[np.float64], candidate: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which matches fit a fundamental matrix, for eight matches or more; arguments and answer as of :func:`fitting`.

    None does if half of them fit it only because they are on one line.
    """
    matrix = inliers = None
    with suppress(cv2.error):  # of some degenerate matches
        # Its random numbers start with the same seed at each call.
        matrix, inliers = cv2.findFundamentalMat(query, candidate, cv2.USAC_MAGSAC, THRESHOLD, CONFIDENCE, ITERATIONS)
    flags = _flags(inliers, len(query))
    if (
        matrix is not None
        and 2 * _on_lines(np.asarray(matrix, np.float64), query, candidate)[flags].sum() > flags.sum()
    ):
        return np.zeros(len(query), np.bool_)
    return flags


def _on_lines(
    matrix: NDArray[np.float64], query: NDArray[np.float64], candidate: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Which matches lie near one of the two lines of which the nearest matrix of rank 1 is made; bool [m]."""
    left, _, right = np.linalg.svd(matrix)
    near = np.zeros(len(query), np.bool_)
    for line, points in ((right[0], query), (left[:, 0], candidate)):
        near |= np.abs(points @ line[:2] + line[2]) <= 2 * THRESHOLD * np.hypot(line[0], line[1])
    return near


def fitting_plane(query: NDArray[np.float64], candidate: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which matches fit a homography, for eight matches or more; arguments and answer as of :func:`fitting`."""
    inliers = None
    with suppress(cv2.error):
        _, inliers = cv2.findHomography(
            query, candidate, cv2.USAC_MAGSAC, PLANE_THRESHOLD, None, ITERATIONS, CONFIDENCE
        )
    return _flags(inliers, len(query))


def _flags(inliers: object, count: int) -> NDArray[np.bool_]:
    return np.zeros(count, np.bool_) if inliers is None else np.asarray(inliers).ravel().astype(np.bool_)


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
    query: Keypoints, queried: NDArray[np.float32], shown: NDArray[np.float64], candidate: Keypoints, least: float
) -> Verification | None:
    matches = mutual_matches(queried, candidate.descriptors.astype(np.float32))
    if len(matches) < least * min(len(query), len(candidate)):
        return None
    ours, theirs = shown[matches[:, 0]], points_of(candidate)[matches[:, 1]]
    inliers = fitting(ours, theirs)
    chance = max(chance_of(query), chance_of(candidate))
    cells = query.positions[matches[inliers, 0]].astype(np.int64) * GRID >> 16
    spread = len(np.unique(cells[:, 1] * GRID + cells[:, 0])) / GRID**2
    found = evidence(len(matches), int(inliers.sum()), chance)
    return Verification((len(query), len(candidate)), matches, inliers, found, spread)


def points_of(keypoints: Keypoints) -> NDArray[np.float64]:
    """Positions in pixels of the frame as the network sees it, float64 [n, 2]."""
    return keypoints.pixels() * shown_scale(keypoints.width, keypoints.height)


def chance_of(keypoints: Keypoints) -> float:
    """α, the share of a picture that lies within the threshold of its longest line."""
    scale = shown_scale(keypoints.width, keypoints.height)
    width, height = keypoints.width * scale, keypoints.height * scale
    return min(0.5, 2 * THRESHOLD * hypot(width, height) / (width * height))
