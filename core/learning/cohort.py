"""From which score on a learnt look is believed: the frames of its own run from elsewhere are its cohort.

Frames of one night look more like one another than like anything by day.  In a map of days, the first look by night
therefore attracts the frames of every night, and leads over all other places by far: a verdict that compares scores
within the map believes it.  The run that a look is from tells how much it is like frames of its condition that show
other places, and a match counts only if it would be believed among these.  Speaker verification does the same with the
scores of a cohort of impostors (Rosenberg et al., The use of cohort normalized scores for speaker verification, 1992).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.belief import PlaceGraph
from core.belief.evidence import believable_score
from core.judgement.background import GUARD_FACTOR
from core.judgement.verdict import Calibration
from core.learning.frames import Trail

LEAST_COHORT = 20
"""A look with fewer frames of its run elsewhere is not learnt: nobody knows what else looks like it.  It is a third of
the places from which on a map imagines none (``background.FULL``)."""

CLEAR = 1.2
"""Frames up to so many same-place radii away may show the same place, as odometry is not exact.  Those beyond show
another."""

STRICTER = 1.3
"""A look is believed from this many times the score on at which its cohort would be left behind.  After a year on
corridor, of 444 frames in four conditions 325, 383 and 358 are recognized rightly with 1, 1.15 and 1.3, and 48, 27 and
9 wrongly; without looks it is 184 and 11."""


@dataclass(frozen=True)
class Cohort:
    """The frames of a run that show other places than one of them, int64 [k] and [m].

    beside: those that may overlap with it.
    far: those that cannot.
    """

    beside: NDArray[np.int64]
    far: NDArray[np.int64]


def cohort_of(trail: Trail, number: int, graph: PlaceGraph, pace: float | None = None) -> Cohort:
    """The frames of a run that show other places than one of them, by odometry.

    Covered and constant ones are left out, and those before or after a motion that is not known.

    Args:
        pace: frames of the map in a metre, for maps without poses; None: not known.
    """
    same = graph.neighborhood
    radius = same.radius if graph.posed.any() or not pace else max(same.frames, 1) / pace
    apart = np.abs(trail.points - trail.points[number])
    counts = np.array([one.sight is None for one in trail.frames], np.bool_) & (trail.piece == trail.piece[number])
    far = apart > GUARD_FACTOR * radius
    return Cohort(np.flatnonzero(counts & ~far & (apart > CLEAR * radius)), np.flatnonzero(counts & far))


def least_score(beside: NDArray[np.floating], far: NDArray[np.floating], calibration: Calibration) -> float | None:
    """The score from which on a match with a look is believed among its cohort; None if that is too small.

    Args:
        beside, far: float [k] and [m], the scores of both stages of the look against the frames of its :class:`Cohort`.
        calibration: by which the map's queries are judged.
    """
    if len(far) < LEAST_COHORT:
        return None
    rest = np.sort(np.asarray(far, np.float64))[::-1]
    believable = believable_score(rest, len(rest), calibration)[1]
    return max(STRICTER * believable, float(beside.max(initial=-np.inf)))
