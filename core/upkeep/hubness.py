"""Places that match everything: hubs among a map's own descriptors, and places that pass for others.

In many dimensions some points are among the nearest neighbours of far more points than chance would have it
(Radovanović, Nanopoulos and Ivanović, "Hubs in space", JMLR 11, 2010): N_k(x), the number of points that have x among
their k nearest, is skewed to the right.  A place that is such a hub draws the queries of places that nobody enrolled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NEIGHBOURS = 10
"""k of N_k where the map has as many places."""

SIGNIFICANT = 4.0
"""A hub's count is so many standard deviations above what chance would give it, and at least three times as much."""

NONE = -1
"""Stands for a neighbour that there is not, in a map of few places."""


def occurrences(neighbours: NDArray[np.int64], places: int) -> NDArray[np.int64]:
    """N_k of every place: in how many lists of nearest neighbours it stands.

    Args:
        neighbours: int64 [q, k], places as 0 … places - 1, or NONE; each row without repetition.

    Returns:
        int64 [places].
    """
    found = neighbours[neighbours != NONE]
    return np.bincount(found, minlength=places).astype(np.int64)


def skewness(counts: NDArray[np.int64]) -> float:
    """S of N_k, its standardized third moment (section 3 of the paper): 0 where all are alike; hubs make it large."""
    values = counts.astype(np.float64)
    if not len(values) or not (deviation := float(values.std())):
        return 0.0
    return float(((values - values.mean()) ** 3).mean() / deviation**3)


def hubs(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """The places whose count is far beyond chance, most frequent first; int64 [h].

    If neighbours were drawn at random every count would be near a Poisson's with their mean.
    """
    if not len(counts):
        return np.empty(0, np.int64)
    expected = float(counts.mean())
    least = max(3.0 * expected, expected + SIGNIFICANT * math.sqrt(expected), 3.0)
    found = np.flatnonzero(counts > least)
    return found[np.argsort(-counts[found], kind="stable")]


@dataclass(frozen=True)
class Alias:
    """A place that looks more like another than like its own neighbours.

    place, other: positions of the two.
    score: of ``other``, seen from ``place``.
    own: the best score of a place that is the same place; None if none was among those looked at.
    """

    place: int
    other: int
    score: float
    own: float | None


def nearest_others(
    scores: NDArray[np.float32], same: NDArray[np.bool_], k: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The k best of the places that are not the one shown.

    Args:
        scores: float32 [n], of one place's frame against all places of the map.
        same: bool [n], which of them are the same place, itself included.

    Returns:
        int64 [k] and float32 [k], best first; NONE and -inf where there are fewer.
    """
    places, found = np.full(k, NONE, np.int64), np.full(k, -np.inf, np.float32)
    others = np.flatnonzero(~same)
    best = others[np.argsort(-scores[others], kind="stable")[:k]]
    places[: len(best)], found[: len(best)] = best, scores[best]
    return places, found
