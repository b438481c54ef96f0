"""From which score on a learnt look is believed: the frames of its own run from elsewhere are its cohort.

Frames of one night look more like one another than like anything by day.  In a map of days, the first look by night
therefore attracts the frames of every night, and leads over all other places by far: a verdict that compares scores
within the map believes it.  The run that a look is from tells how much it is like frames of its condition that show
other places, and a match counts only if it would be believed among these.  Speaker verification does the same with the
scores of a cohort of impostors (Rosenberg et al., The use of cohort normalized scores for speaker verification, 1992).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.belief import PlaceGraph
from core.belief.evidence import believable_score
from core.judgement.background import GUARD_FACTOR
from core.judgement.verdict import Calibration
from core.learning.frames import Trail

LEAST_COHORT = 20
"""A look with fewer frames of its run elsewhere is not learnt: nobody knows what else looks like it."""


def elsewhere(trail: Trail, number: int, graph: PlaceGraph, pace: float | None = None) -> NDArray[np.int64]:
    """The frames of a run that cannot show what one of them shows, by odometry, int64 [k].

    Covered and constant ones are left out, and those before or after a motion that is not known.

    Args:
        pace: frames of the map in a metre, for maps without poses; None: not known.
    """
    same = graph.neighborhood
    reach = GUARD_FACTOR * same.radius
    if not graph.posed.any() and pace:
        reach = GUARD_FACTOR * max(same.frames, 1) / pace
    apart = np.abs(trail.points - trail.points[number]) > reach
    counts = np.array([one.sight is None for one in trail.frames], np.bool_)
    return np.flatnonzero(apart & counts & (trail.piece == trail.piece[number]))


def least_score(scores: NDArray[np.floating], calibration: Calibration) -> float | None:
    """The score from which on a match with a look is believed among its cohort; None if that is too small.

    Args:
        scores: float [k], of both stages, of the look against the frames of its run that are elsewhere.
        calibration: by which the map's queries are judged.
    """
    if len(scores) < LEAST_COHORT:
        return None
    rest = np.sort(np.asarray(scores, np.float64))[::-1]
    return believable_score(rest, len(rest), calibration)[1]
