"""Which places of a ranking the second stage examines: the best ones, and enough of the best *other* places.

Where frames were taken densely, or the robot stood still, one place's neighbours can fill the whole list of
candidates.  Then nothing was examined that the best could be held against: a twin elsewhere would keep its low
first score, the lead would be large by nature, and the answer could never be ambiguous.  So the list goes on, past
the neighbours of the best, until a few places that are another place were compared as closely.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.judgement.verdict import TOP_PLACES
from core.places import Neighborhood, Whereabouts

Array = NDArray[np.float32]
Positions = NDArray[np.int64]

ROUNDS = 3
"""One of the further places may turn out the best and have neighbours of its own; so often the others are counted."""


@dataclass(frozen=True)
class Examined:
    """A ranking of n places once its candidates have gained.

    order: int64 [n], positions in the old ranking, best first; equal scores keep their order.
    scores: float32 [n], in the new order.
    examined: bool [n], which of the places, in the new order, were examined.
    """

    order: Positions
    scores: Array
    examined: NDArray[np.bool_]


def examine(
    scores: Array,
    whereabouts: Whereabouts,
    neighborhood: Neighborhood,
    candidates: int,
    gains: Callable[[Positions], Array],
    others: int = TOP_PLACES,
) -> Examined:
    """Let the best of a ranking gain by the second stage.

    The first ``candidates`` are examined; then, as long as fewer than ``others`` of those examined are another
    place than the best one, the best of the rest that are.

    Args:
        scores: float32 [n], of the first stage, best first.
        whereabouts: of the same n places in the same order.
        neighborhood: which places are the same place.
        candidates: of the encoder; 0: it has no second stage, and nothing is examined.
        gains: of the second stage for positions in the ranking, int64 [k] to float32 [k], at least 0.
    """
    raised = scores.copy()
    done = np.zeros(len(scores), np.bool_)
    ahead = np.arange(min(candidates, len(scores)))
    for _ in range(ROUNDS):
        if not len(ahead):
            break
        raised[ahead] += gains(ahead)
        done[ahead] = True
        best = int(np.flatnonzero(done)[np.argmax(raised[done])])
        elsewhere = ~whereabouts.near(best, neighborhood)
        missing = max(0, others - int((done & elsewhere).sum()))
        ahead = np.flatnonzero(elsewhere & ~done)[:missing]
    order = np.argsort(-raised, kind="stable")
    return Examined(order, raised[order], done[order])
