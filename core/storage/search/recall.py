"""How often do the codes of a map find what an exact search finds?

Nobody knows what robots will ask, so places of the map are looked for by made-up second visits: of every block of a
descriptor's values a third, chosen at random, is that of the place, the rest is that of another place at random.  What
an exact search of the same snapshot finds first is the truth, whichever place that is.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from core.storage.search.snapshot import SHORTLIST, Snapshot
from core.storage.search.tiers import Recall

QUERIES = 128
OWN_SHARE = 1 / 3
BLOCK = 128
"""Values that come from one place together: a word's part of the default encoder's descriptors."""

_TOGETHER = 256  # rows compared exactly at a time


def second_visits(snapshot: Snapshot, count: int, seed: int = 0) -> NDArray[np.float32]:
    """Made-up descriptors of second visits to living places, float32 [count, D]."""
    random = np.random.default_rng(seed)
    living = np.flatnonzero(snapshot.alive)
    own, other = (snapshot.descriptors_at(random.choice(living, count)) for _ in range(2))
    blocks = -(-snapshot.dimension // BLOCK)
    is_own = np.repeat(random.random((count, blocks)) < OWN_SHARE, BLOCK, axis=1)[:, : snapshot.dimension]
    return np.where(is_own, own, other)


def best_rows(
    snapshot: Snapshot, queries: NDArray[np.float32], progress: Callable[[int, int], None]
) -> NDArray[np.float32]:
    """The largest inner product of each query with a living place, by comparing them all: float32 [B].

    Args:
        progress: told rows done and rows in all; may raise to stop it.
    """
    living = np.flatnonzero(snapshot.alive)
    best = np.full(len(queries), -np.inf, np.float32)
    for start in range(0, len(living), _TOGETHER):
        products = queries @ snapshot.descriptors_at(living[start : start + _TOGETHER]).T
        best = np.maximum(best, products.max(axis=1))
        progress(start, len(living))
    return best


def measured(snapshot: Snapshot, progress: Callable[[int, int], None] = lambda done, total: None) -> Recall | None:
    """The recall of a snapshot that has codes; None without places.

    What is found first must be worth as much as the best, to float32 rounding: of places that are alike any will do.
    """
    if not len(snapshot):
        return None
    queries = second_visits(snapshot, QUERIES)
    truth = best_rows(snapshot, queries, progress)
    found = np.array([snapshot.search(query)[1][0] for query in queries])
    tolerance = 1e-4 * np.maximum(1e-6, np.abs(truth))
    right = float(np.mean(found >= truth - tolerance))
    return Recall(at_1=right, queries=len(queries), shortlist=SHORTLIST, places=len(snapshot))
