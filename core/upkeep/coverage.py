"""Gaps along a sequence: steps from one frame to the next that are unusually large for that sequence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.places import NO_POSE, NO_TIME, Whereabouts

Measure = Literal["distance", "time", "similarity"]

LONG = 3.0
"""A gap is more than this many times as long as the sequence's median step."""

DEVIATIONS = 4.0
"""A gap is also more than this many standard deviations longer than the median step."""

TO_DEVIATION = 1.4826
"""The standard deviation of a normal distribution is this many times its median absolute deviation."""

FEWEST_STEPS = 5
"""A sequence with fewer known steps has no gaps."""


@dataclass(frozen=True)
class Gap:
    """An unusual step between two consecutive frames.

    before: the position of the first of the two in its sequence.
    measure: the quantity: the distance in metres, the time in seconds, or the similarity of the two (their score).
    value, median: of this step, and of all steps of the sequence.
    """

    before: int
    measure: Measure
    value: float
    median: float

    @property
    def severity(self) -> float:
        """How many times the median the step is (for similarity, the median divided by it); at least 1."""
        high, low = (self.median, self.value) if self.measure == "similarity" else (self.value, self.median)
        return max(1.0, high / max(low, 1e-9)) if high > 0 else 1.0


def distances(where: Whereabouts) -> NDArray[np.float64]:
    """Metres from each of n places to the next, float64 [n - 1]; NaN without two poses of one kind."""
    return _distances(where.kind, where.position)


def _distances(kind: NDArray[np.int8], position: NDArray[np.float64]) -> NDArray[np.float64]:
    steps = np.sqrt(np.square(np.diff(position, axis=0)).sum(axis=1))
    known = (kind[1:] == kind[:-1]) & (kind[1:] != NO_POSE)
    return np.where(known, steps, np.nan)


def durations(where: Whereabouts) -> NDArray[np.float64]:
    """Seconds from each of n places to the next, float64 [n - 1]; NaN without two timestamps."""
    known = (where.timestamp[1:] != NO_TIME) & (where.timestamp[:-1] != NO_TIME)
    moments = np.where(where.timestamp == NO_TIME, 0, where.timestamp)
    return np.where(known, np.diff(moments) / 1e6, np.nan)


def long_steps(steps: NDArray[np.float64], measure: Measure) -> list[Gap]:
    """Find steps that are much longer than the others of the sequence.

    Args:
        steps: float64 [n], not negative; NaN where not known.
        measure: the quantity of the steps.
    """
    known = steps[~np.isnan(steps)]
    if len(known) < FEWEST_STEPS:
        return []
    median, deviation = _spread(known)
    if median <= 0:  # the robot mostly stood still, so that every move would count as a gap
        return []
    least = max(LONG * median, median + DEVIATIONS * deviation)
    return [Gap(int(i), measure, float(steps[i]), median) for i in np.flatnonzero(steps > least)]


def long_ways(where: Whereabouts, walk: NDArray[np.int64], first: NDArray[np.int64]) -> list[Gap]:
    """The gaps of a sequence in metres: the one rule for the health report and for the plan.

    Args:
        where: of n places.
        walk: int64 [k], the positions of the sequence's places, in their order.
        first: int64 [n], which place stands for each (``core.upkeep.redundancy.first_looks``): from one frame of a stop
            to the next is no step.
    """
    stood = first[walk[1:]] == first[walk[:-1]]
    return long_steps(np.where(stood, np.nan, _distances(where.kind[walk], where.position[walk])), "distance")


def backward_steps(durations: NDArray[np.float64]) -> int:
    """How many frames were taken earlier than the frame enrolled before them.

    Args:
        durations: float64 [n], seconds from each frame to the next.
    """
    return int((durations < 0).sum())


def unlike_steps(similarities: NDArray[np.float64]) -> list[Gap]:
    """Find steps between frames that look far less alike than is usual for the sequence.

    Args:
        similarities: float64 [n], scores of consecutive frames; NaN where not known.
    """
    known = similarities[~np.isnan(similarities)]
    if len(known) < FEWEST_STEPS:
        return []
    median, deviation = _spread(known)
    most = min(median / LONG if median > 0 else median, median - DEVIATIONS * deviation)
    return [Gap(int(i), "similarity", float(similarities[i]), median) for i in np.flatnonzero(similarities < most)]


def _spread(values: NDArray[np.float64]) -> tuple[float, float]:
    """The median, and a standard deviation estimated from the median absolute deviation, robust to outliers."""
    median = float(np.median(values))
    return median, TO_DEVIATION * float(np.median(np.abs(values - median)))
