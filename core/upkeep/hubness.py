"""Places that match too many others: hubs among a map's descriptors, and places that are mistaken for others.

In high-dimensional spaces some points are among the nearest neighbours of far more points than chance explains
(Radovanović, Nanopoulos and Ivanović, "Hubs in space", JMLR 11, 2010): N_k(x), the number of points that have x among
their k nearest, is skewed to the right.  A place that is a hub attracts queries of places that are not in the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NEIGHBOURS = 10
"""k of N_k, if the map has as many places."""

SIGNIFICANT = 4.0
"""The count of a hub is this many standard deviations above its expectation, and at least three times as much."""

NONE = -1
"""Stands for a missing neighbour, in a map of few places."""


def occurrences(neighbours: NDArray[np.int64], places: int) -> NDArray[np.int64]:
    """N_k of every place: the number of lists of nearest neighbours that contain it.

    Args:
        neighbours: int64 [q, k], places from 0 to ``places`` - 1, or NONE; each row without repetition.
        places: number of places.

    Returns:
        int64 [places].
    """
    found = neighbours[neighbours != NONE]
    return np.bincount(found, minlength=places).astype(np.int64)


def skewness(counts: NDArray[np.int64]) -> float:
    """The skewness of N_k, its standardized third moment (section 3 of the paper); 0 if all counts are equal."""
    values = counts.astype(np.float64)
    if not len(values) or not (deviation := float(values.std())):
        return 0.0
    return float(((values - values.mean()) ** 3).mean() / deviation**3)


def hubs(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """The places whose count is far beyond chance, the most frequent first; int64 [h].

    If neighbours were drawn at random, the counts would follow a Poisson distribution with their mean.
    """
    if not len(counts):
        return np.empty(0, np.int64)
    expected = float(counts.mean())
    least = max(3.0 * expected, expected + SIGNIFICANT * math.sqrt(expected), 3.0)
    found = np.flatnonzero(counts > least)
    return found[np.argsort(-counts[found], kind="stable")]


@dataclass(frozen=True)
class Alias:
    """A place that looks more like another place than like its own neighbours.

    place, other: positions of the two.
    score: of ``other``, for the frame of ``place``.
    own: the best score of a frame of the same place; None if there was none among those compared.
    """

    place: int
    other: int
    score: float
    own: float | None


def nearest_others(
    scores: NDArray[np.float32], same: NDArray[np.bool_], k: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The k best matches of a place's frame among the other places.

    Args:
        scores: float32 [n], of the frame against all places of the map.
        same: bool [n], which of them are the same place, itself included.
        k: how many to return.

    Returns:
        Positions, int64 [k], and scores, float32 [k], best first; filled up with NONE and -inf.
    """
    places, found = np.full(k, NONE, np.int64), np.full(k, -np.inf, np.float32)
    others = np.flatnonzero(~same)
    best = others[np.argsort(-scores[others], kind="stable")[:k]]
    places[: len(best)], found[: len(best)] = best, scores[best]
    return places, found
