"""Gaps along a sequence: steps from one frame to the next that are out of the ordinary for that sequence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.places import NO_POSE, NO_TIME, Whereabouts

Measure = Literal["distance", "time", "similarity"]

LONG = 3.0
"""A step is a gap if it is so many times as long as the sequence's median step …"""

DEVIATIONS = 4.0
"""… and so many standard deviations, as estimated from the median deviation, away from it."""

TO_DEVIATION = 1.4826
"""Of a normal distribution the standard deviation is so many times the median absolute deviation."""

FEWEST_STEPS = 5
"""In a shorter sequence nothing is out of the ordinary."""


@dataclass(frozen=True)
class Gap:
    """A step between two frames that follow each other.

    before: position of the first of the two in its sequence.
    measure: what is out of the ordinary: metres, seconds, or how alike the two look.
    value, median: of this step, and of all steps of the sequence.
    """

    before: int
    measure: Measure
    value: float
    median: float

    @property
    def severity(self) -> float:
        """How many times the ordinary it is; at least 1."""
        high, low = (self.median, self.value) if self.measure == "similarity" else (self.value, self.median)
        return max(1.0, high / max(low, 1e-9)) if high > 0 else 1.0


def distances(where: Whereabouts) -> NDArray[np.float64]:
    """Metres from each of n places to the next, float64 [n - 1]; NaN where one has no pose or poses differ in kind."""
    steps = np.sqrt(np.square(np.diff(where.position, axis=0)).sum(axis=1))
    known = (where.kind[1:] == where.kind[:-1]) & (where.kind[1:] != NO_POSE)
    return np.where(known, steps, np.nan)


def durations(where: Whereabouts) -> NDArray[np.float64]:
    """Seconds from each of n places to the next, float64 [n - 1]; NaN where one has no time."""
    known = (where.timestamp[1:] != NO_TIME) & (where.timestamp[:-1] != NO_TIME)
    moments = np.where(where.timestamp == NO_TIME, 0, where.timestamp)
    return np.where(known, np.diff(moments) / 1e6, np.nan)


def long_steps(steps: NDArray[np.float64], measure: Measure) -> list[Gap]:
    """Steps that are much longer than the sequence's others.

    Args:
        steps: float64 [n], not negative where known, NaN where not.
    """
    known = steps[~np.isnan(steps)]
    if len(known) < FEWEST_STEPS:
        return []
    median, deviation = _spread(known)
    if median <= 0:  # most frames stand still: only a jump from there would show, and every move is one
        return []
    least = max(LONG * median, median + DEVIATIONS * deviation)
    return [Gap(int(i), measure, float(steps[i]), median) for i in np.flatnonzero(steps > least)]


def backward_steps(durations: NDArray[np.float64]) -> int:
    """How many frames were taken before the one they follow: the order of enrolment is not that of time."""
    return int((durations < 0).sum())


def unlike_steps(similarities: NDArray[np.float64]) -> list[Gap]:
    """Steps between frames that look far less alike than is ordinary for the sequence.

    Args:
        similarities: float64 [n], scores; NaN where not known.
    """
    known = similarities[~np.isnan(similarities)]
    if len(known) < FEWEST_STEPS:
        return []
    median, deviation = _spread(known)
    most = min(median / LONG if median > 0 else median, median - DEVIATIONS * deviation)
    return [Gap(int(i), "similarity", float(similarities[i]), median) for i in np.flatnonzero(similarities < most)]


def _spread(values: NDArray[np.float64]) -> tuple[float, float]:
    """The median, and a standard deviation that a few outliers do not change."""
    median = float(np.median(values))
    return median, TO_DEVIATION * float(np.median(np.abs(values - median)))
