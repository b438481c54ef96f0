"""Matches of keypoints: two of them match if each is the other's nearest neighbour by the cosine of their descriptors.

A glance at a place is its best ``GLANCED`` keypoints.  How many of them match those of a query says which of many
places are worth more than a glance; compiled loops (``core.kernels.matching``) count them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.geometry.keypoints import LENGTH, RESOLUTION, Keypoints
from core.kernels.matching import mutual_neighbors

LEAST_COSINE = 0.75
"""Of two descriptors that can match."""
GLANCED = 64
"""Keypoints of a place, and of a query, by which it is chosen whether they are compared as a whole."""

_LEAST_PRODUCT = LEAST_COSINE * RESOLUTION**2


def neighbors_among(query: Keypoints, candidates: Sequence[Keypoints]) -> NDArray[np.int32]:
    """The keypoints of candidates that match those of a query.

    Products of whole numbers are exact in float32 here: 64 · 127² < 2^24.  So every processor finds the same matches.

    Returns:
        int32 [k, n], the number in each candidate of each of the query's n keypoints; -1: none matches; ties to the
        lower one.
    """
    width = max((len(one) for one in candidates), default=0)
    if not len(query) or not width:
        return np.full((len(candidates), len(query)), -1, np.int32)
    theirs = np.zeros((len(candidates), width, LENGTH), np.float32)  # rows of zeros match nothing
    for made, one in zip(theirs, candidates, strict=True):
        made[: len(one)] = one.descriptors
    products = query.descriptors.astype(np.float32) @ theirs.reshape(-1, LENGTH).T
    return np.asarray(mutual_neighbors(products, width, _LEAST_PRODUCT), np.int32)


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
