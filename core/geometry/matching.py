"""Matches of keypoints: two of them match if each is the other's nearest neighbour by the cosine of their descriptors.

A glance at a place is its best ``GLANCED`` keypoints.  How many of them match those of a query says which of many
places are worth more than a glance; compiled loops (``core.kernels.matching``) count them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.geometry.keypoints import LENGTH, RESOLUTION, Keypoints
from core.kernels.matching import mutual_neighbors

LEAST_COSINE = 0.75
"""Of two descriptors that can match."""
GLANCED = 64
"""Keypoints of a place, and of a query, by which it is chosen whether they are compared as a whole."""

_LEAST_PRODUCT = LEAST_COSINE * RESOLUTION**2


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
    (there,) = mutual_neighbors(query @ candidate.T, len(candidate), _LEAST_PRODUCT)
    matched = np.flatnonzero(there >= 0)
    return np.stack([matched, there[matched]], axis=1)


def glance_at(keypoints: Keypoints) -> NDArray[np.int8]:
    """The descriptors of the best keypoints, int8 [GLANCED, 64]; rows of zeros, which match nothing, where they end."""
    made = np.zeros((GLANCED, LENGTH), np.int8)
    best = keypoints.descriptors[:GLANCED]
    made[: len(best)] = best
    return made


def count_matches(query: Keypoints, glances: NDArray[np.int8]) -> NDArray[np.int64]:
    """How many of the query's best keypoints match each of n places at a glance, int64 [n].

    Args:
        glances: int8 [n, GLANCED, 64], see :func:`glance_at`.
    """
    ours = query.descriptors[:GLANCED].astype(np.float32)
    theirs = glances.reshape(-1, LENGTH).astype(np.float32)
    neighbors = mutual_neighbors(ours @ theirs.T, GLANCED, _LEAST_PRODUCT)
    return (neighbors >= 0).sum(axis=1)
