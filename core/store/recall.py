"""Measuring how often a search by codes finds the result of an exact search.

Real queries are not known, so places of the map are searched for by synthetic second visits: a random third of the
blocks of a descriptor is that of the place, the others are those of another random place.  The best place of an exact
search of the same snapshot is the truth.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from core.maps.status import Recall
from core.store.snapshot import SHORTLIST, Snapshot

QUERIES = 128
OWN_SHARE = 1 / 3
BLOCK = 128
"""Values of a block: those of one visual word of the default encoder."""

_TOGETHER = 256  # rows compared exactly at a time


def second_visits(snapshot: Snapshot, count: int, seed: int = 0) -> NDArray[np.float32]:
    """Synthetic descriptors of second visits to places of the map, float32 [count, D]."""
    random = np.random.default_rng(seed)
    living = np.flatnonzero(snapshot.alive)
    own, other = (snapshot.descriptors_at(random.choice(living, count)) for _ in range(2))
    blocks = -(-snapshot.dimension // BLOCK)
    is_own = np.repeat(random.random((count, blocks)) < OWN_SHARE, BLOCK, axis=1)[:, : snapshot.dimension]
    return np.where(is_own, own, other)


def best_products(
    snapshot: Snapshot, queries: NDArray[np.float32], progress: Callable[[int, int], None]
) -> NDArray[np.float32]:
    """The largest inner product of each query with any place, by comparing all places: float32 [B].

    Args:
        progress: called with the number of rows done and of all; its exceptions end the work.
    """
    living = np.flatnonzero(snapshot.alive)
    best = np.full(len(queries), -np.inf, np.float32)
    for start in range(0, len(living), _TOGETHER):
        products = queries @ snapshot.descriptors_at(living[start : start + _TOGETHER]).T
        best = np.maximum(best, products.max(axis=1))
        progress(start, len(living))
    return best


def measure_recall(
    snapshot: Snapshot, progress: Callable[[int, int], None] = lambda done, total: None
) -> Recall | None:
    """The recall@1 of a snapshot with codes against exact search; None without places.

    A result counts as right if its inner product equals the best one up to float32 rounding, so that any of several
    places with equal descriptors will do.
    """
    if not len(snapshot):
        return None
    queries = second_visits(snapshot, QUERIES)
    truth = best_products(snapshot, queries, progress)
    found = np.array([snapshot.search(query)[1][0] for query in queries])
    tolerance = 1e-4 * np.maximum(1e-6, np.abs(truth))
    right = float(np.mean(found >= truth - tolerance))
    return Recall(at_1=right, queries=len(queries), shortlist=SHORTLIST, places=len(snapshot))
