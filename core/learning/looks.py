"""Which looks a place keeps: those that cover the conditions in which it was seen, with few repetitions.

The first look of a place, with which the map was made, stays.  A look that repeats another, so that either would be
recognized by the other with a high score, adds nothing; nor does one that never helps.  Of the rest, as many stay as
may: one after the other is chosen, each time the look that is least like all those chosen before (farthest-first
traversal, Gonzalez, Clustering to minimize the maximum intercluster distance, 1985), so that every look that goes is
like one that stays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.learning.statistics import LookStatistics

MOST_LOOKS = 3
"""Looks of a place, the first included."""

REPEATS = 2.5
"""A look repeats another if its score against it is this many times the score at which it would just be believed; as
``verdict.ALIKE``, and not measured here."""


def kept(
    scores: NDArray[np.float32],
    believable: float,
    most_looks: int = MOST_LOOKS,
    services: Sequence[LookStatistics] | None = None,
    fixed: int = 1,
) -> NDArray[np.int64]:
    """The looks of a place that stay, int64 [m], fixed <= m <= most_looks, in the order of the given ones.

    Args:
        scores: float32 [k, k], of both stages, of every look against every other; the first is that of the map.
        believable: the score at which a frame of this place would just be recognized.
        services: how each has served; None: nothing is known.
        fixed: how many of the first stay whatever they are, also if they are more than ``most_looks``: that of the map,
            and those that people added.

    Raises:
        ValueError: there is no look, or none may stay.
    """
    count = len(scores)
    if not 1 <= fixed <= count or most_looks < 1:
        raise ValueError("a place keeps its first look")
    alike = np.maximum(scores, scores.T).astype(np.float64)
    served = [LookStatistics()] * count if services is None else list(services)
    left = [number for number in range(fixed, count) if not (served[number].idle or served[number].misleads)]
    chosen = list(range(fixed))
    while left and len(chosen) < most_looks:
        nearest = alike[np.ix_(left, chosen)].max(axis=1)
        farthest = min(range(len(left)), key=lambda at: (nearest[at], -served[left[at]].right, left[at]))
        if nearest[farthest] >= REPEATS * believable:
            break
        chosen.append(left.pop(farthest))
    return np.array(sorted(chosen), np.int64)
