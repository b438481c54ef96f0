"""Prior knowledge of where a robot is: constraints on places, as filters or as weights.

A constraint used as a *filter* leaves only the places that satisfy it.  Used as a *soft prior* it weighs them: with
the probability t ("trust") the prior knowledge is right, and with 1 - t it says nothing, so that a place has the weight

    w = (1 - t) + t · Π fit,    fit in [0, 1],

and log w, at most 0 and at least log(1 - t), is added to the place's log odds.  A prior can make an answer less
certain or choose among places that look alike, but it never makes a match more certain than the frame does; and a robot
that was carried away is still found if the evidence is strong enough.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from core.judgement.verdict import Calibration
from core.places import EARTH_RADIUS, GEOGRAPHIC, METRIC, NO_LEVEL, NO_TIME, Pose, Whereabouts

Flags = NDArray[np.bool_]
Values = NDArray[np.float64]

LARGEST_TRUST = 0.999
"""The trust is limited to this: no prior is certain.  A filter is."""

TOLERANCE = 1e-8
"""Metres by which a place may be beyond the edge of an area, to allow for the rounding of positions on the Earth."""

UNCALIBRATED_STEEPNESS = 4.0
"""Log odds lost from the threshold down to a decision value of 0, for calibrations without a curve."""


class Constraint(Protocol):
    """A statement that is true of some places."""

    def holds(self, places: Whereabouts) -> Flags:
        """Which of the n places satisfy it; bool [n]."""

    def fit(self, places: Whereabouts) -> Values:
        """How well each of the n places fits it; float64 [n] in [0, 1]."""


@dataclass(frozen=True)
class Disc:
    """Within ``radius`` metres of a position; the fit is Gaussian with ``radius`` as its standard deviation.

    A position in metres without z is compared in the plane.  Places without a pose of its kind are outside.
    """

    centre: Pose
    radius: float

    def _squares(self, places: Whereabouts) -> Values:
        centre = self.centre.position()
        axes = 2 if self.centre.kind() == "metric" and self.centre.z is None else 3
        squares = np.zeros(len(places))
        for axis in range(axes):
            squares += np.square(places.position[:, axis] - centre[axis])
        squares[places.kind != (METRIC if self.centre.kind() == "metric" else GEOGRAPHIC)] = np.inf
        return squares

    def holds(self, places: Whereabouts) -> Flags:
        return self._squares(places) <= (self._straight() + TOLERANCE) ** 2

    def fit(self, places: Whereabouts) -> Values:
        return np.exp(-self._squares(places) / (2 * max(self._straight(), 1e-3) ** 2))

    def _straight(self) -> float:
        """The radius as a straight distance: on the sphere, the chord of its arc."""
        if self.centre.kind() == "metric":
            return self.radius
        return 2 * EARTH_RADIUS * float(np.sin(min(self.radius / (2 * EARTH_RADIUS), np.pi / 2)))


@dataclass(frozen=True)
class GeographicBox:
    """Between two parallels and two meridians, in degrees, edges included; ``west`` > ``east`` crosses ±180°."""

    west: float
    south: float
    east: float
    north: float

    def holds(self, places: Whereabouts) -> Flags:
        x, y, z = places.position.T
        south, north = (EARTH_RADIUS * np.sin(np.radians(edge)) for edge in (self.south, self.north))
        inside = (places.kind == GEOGRAPHIC) & (z >= south - TOLERANCE) & (z <= north + TOLERANCE)
        width = (self.east - self.west) % 360
        if width == 0 and self.east != self.west:
            return inside  # all around
        # Half-planes through the axis instead of longitudes: no angle is computed, and nothing jumps at ±180°.
        # At a pole x and y are 0, which is on every meridian.
        west, east, middle = (np.radians(angle) for angle in (self.west, self.east, self.west + width / 2))
        after_west = np.cos(west) * y - np.sin(west) * x >= -TOLERANCE
        before_east = np.sin(east) * x - np.cos(east) * y >= -TOLERANCE
        if width > 180:
            return inside & (after_west | before_east)
        return inside & after_west & before_east & (np.cos(middle) * x + np.sin(middle) * y >= -TOLERANCE)

    def fit(self, places: Whereabouts) -> Values:
        return self.holds(places).astype(np.float64)


@dataclass(frozen=True)
class Facing:
    """Heading within ``tolerance`` degrees of ``heading``; the fit is Gaussian in the angle between them.

    Headings follow the convention of the places' poses.  Places without a known heading do not satisfy it.
    """

    heading: float
    tolerance: float

    def _apart(self, places: Whereabouts) -> NDArray[np.float32]:
        """Degrees between the headings, in [0, 180]; NaN if a place's is not known."""
        apart = np.abs(places.heading - np.float32(self.heading % 360))
        return np.minimum(apart, np.float32(360) - apart)

    def holds(self, places: Whereabouts) -> Flags:
        return self._apart(places) <= np.float32(self.tolerance + 1e-4)  # headings are stored as float32

    def fit(self, places: Whereabouts) -> Values:
        apart = np.nan_to_num(self._apart(places).astype(np.float64), nan=np.inf)
        return np.exp(-0.5 * np.square(apart / max(self.tolerance, 1e-3)))


@dataclass(frozen=True)
class Period:
    """Taken at or after ``after`` and at or before ``before``, microseconds since 1970 UTC; None: no bound."""

    after: int | None
    before: int | None

    def holds(self, places: Whereabouts) -> Flags:
        found = places.timestamp != NO_TIME
        if self.after is not None:
            found &= places.timestamp >= self.after
        if self.before is not None:
            found &= places.timestamp <= self.before
        return found

    def fit(self, places: Whereabouts) -> Values:
        return self.holds(places).astype(np.float64)


@dataclass(frozen=True)
class InSequences:
    """In one of these sequences, given by their codes."""

    codes: tuple[int, ...]

    def holds(self, places: Whereabouts) -> Flags:
        found = np.zeros(len(places), np.bool_)
        for code in self.codes:
            found |= places.sequence == code
        return found

    def fit(self, places: Whereabouts) -> Values:
        return self.holds(places).astype(np.float64)


@dataclass(frozen=True)
class OnLevels:
    """On one of these storeys, given by their codes (:func:`core.places.level_code`).

    Places without a level do not satisfy it, but fit: a statement of a storey says nothing about them.
    """

    codes: tuple[int, ...]

    def holds(self, places: Whereabouts) -> Flags:
        return np.isin(places.level, self.codes)

    def fit(self, places: Whereabouts) -> Values:
        return (self.holds(places) | (places.level == NO_LEVEL)).astype(np.float64)


@dataclass(frozen=True)
class NotLately:
    """Not among the robot's own last frames, which it would otherwise find at every standstill.

    sequence: code of its own sequence.
    ordinal: places of that sequence from this ordinal on are excluded; None: no bound.
    moment, span: microseconds; places of that sequence less than ``span`` from ``moment``, and those without a known
        time, are excluded; None: no bound.
    """

    sequence: int
    ordinal: int | None
    moment: int | None = None
    span: int = 0

    def holds(self, places: Whereabouts) -> Flags:
        lately = np.zeros(len(places), np.bool_)
        if self.ordinal is not None:
            lately |= places.ordinal >= self.ordinal
        if self.moment is not None:
            timed = places.timestamp != NO_TIME
            # In floating point, as the difference of two int64 may overflow; it is exact over 285 years.
            apart = np.abs(places.timestamp.astype(np.float64) - self.moment)
            lately |= ~timed | (apart < self.span)
        return ~(lately & (places.sequence == self.sequence))

    def fit(self, places: Whereabouts) -> Values:
        return self.holds(places).astype(np.float64)


def holding(constraints: Iterable[Constraint], places: Whereabouts) -> Flags:
    """Which of n places satisfy all of the constraints; bool [n]."""
    found = np.ones(len(places), np.bool_)
    for constraint in constraints:
        found &= constraint.holds(places)
    return found


def log_weights(fits: Sequence[Values], trust: float) -> Values:
    """log w of n places by the prior knowledge (see the module); float64 [n] in [log(1 - trust), 0].

    Args:
        fits: float64 [n] in [0, 1], one array for each constraint, at least one.
        trust: probability that the prior knowledge is right, in [0, 1].
    """
    trusted = min(trust, LARGEST_TRUST)
    product = fits[0].copy()
    for fit in fits[1:]:
        product *= fit
    return np.log((1 - trusted) + trusted * product)


def decision_slope(calibration: Calibration) -> float:
    """By how much the log odds of a match grow with its decision value.

    They grow with its score by about as much, as √(s · (s - top)) grows by about one with s.  Without a curve, the
    threshold is taken for even odds.
    """
    if calibration.curve is not None:
        return calibration.curve.slope
    return UNCALIBRATED_STEEPNESS / max(abs(calibration.threshold), 1e-6)


def log_odds(decision: float, calibration: Calibration, imagined: float = 0.0) -> float:
    """The log odds of a match with this decision value; without a curve, with even odds at the threshold.

    Args:
        imagined: the share of the background that was imagined.
    """
    if calibration.curve is not None:
        return float(calibration.curve.log_odds(decision, imagined))
    return decision_slope(calibration) * (decision - calibration.threshold)


def weighed(scores: NDArray[np.float32], weights: Values, calibration: Calibration) -> NDArray[np.float32]:
    """Lower scores by a prior: the log weights are converted to units of the score and added.

    A score does not fall below the mean of unrelated frames unless it was lower before: a place that the prior rules
    out counts as an unrelated one, and must not make the others stand out more.

    Args:
        scores: float32 [n].
        weights: float64 [n], log weights.

    Returns:
        float32 [n].
    """
    lowered = scores + (weights / decision_slope(calibration)).astype(np.float32)
    return np.asarray(np.maximum(lowered, np.minimum(scores, np.float32(calibration.background_mean))), np.float32)
