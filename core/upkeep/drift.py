"""A map's answers week by week, and whether they drift: with the seasons, new furniture, a camera that was moved."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from typing import get_args

import numpy as np

from core.judgement.verdict import Verdict

SCORE_BINS = 20
"""Bins of equal width for scores from 0 to 1; scores outside count in the first or last bin."""

FEWEST_QUERIES = 20
"""A week with fewer queries does not count in a trend."""

FEWEST_WEEKS = 4
"""With fewer weeks there is no trend."""

SIGNIFICANT = 3.0
"""A trend is reported as drift if its slope is this many standard errors from zero."""


@dataclass(frozen=True)
class Week:
    """Counts of the answers of one week, from its Monday, and sums over those with a score.

    blank: how many of the unknown ones have no score: the frame had no region, or the map no place.
    score, score_squares, decision, decision_squares: sums of scores, decision values and their squares.
    bins: counts of the scores, by SCORE_BINS bins from 0 to 1.
    """

    monday: date
    recognized: int = 0
    ambiguous: int = 0
    unknown: int = 0
    blank: int = 0
    score: float = 0.0
    score_squares: float = 0.0
    decision: float = 0.0
    decision_squares: float = 0.0
    bins: tuple[int, ...] = (0,) * SCORE_BINS

    @classmethod
    def of(cls, monday: date, verdict: Verdict, score: float | None, decision: float | None) -> Week:
        """A week with one answer."""
        recognized, ambiguous, unknown = (int(verdict == each) for each in get_args(Verdict))
        if score is None:
            return cls(monday, recognized, ambiguous, unknown, blank=1)
        bins = [0] * SCORE_BINS
        bins[min(SCORE_BINS - 1, max(0, int(score * SCORE_BINS)))] = 1
        value = 0.0 if decision is None else decision
        squares = score**2, value**2
        return cls(monday, recognized, ambiguous, unknown, 0, score, squares[0], value, squares[1], tuple(bins))

    @property
    def queries(self) -> int:
        """How many answers there are."""
        return self.recognized + self.ambiguous + self.unknown

    @property
    def compared(self) -> int:
        """How many answers have a score."""
        return self.queries - self.blank

    def mean_score(self) -> float | None:
        """The mean of the best scores; None if there are none."""
        return self.score / self.compared if self.compared else None

    def mean_decision(self) -> float | None:
        """The mean of the decision values; None if there are none."""
        return self.decision / self.compared if self.compared else None

    def unknown_rate(self) -> float | None:
        """The share of unknown answers; None if there are no answers."""
        return self.unknown / self.queries if self.queries else None

    def __add__(self, other: Week) -> Week:
        if self.monday != other.monday:
            raise ValueError("two different weeks are not added")
        return Week(
            self.monday,
            self.recognized + other.recognized,
            self.ambiguous + other.ambiguous,
            self.unknown + other.unknown,
            self.blank + other.blank,
            self.score + other.score,
            self.score_squares + other.score_squares,
            self.decision + other.decision,
            self.decision_squares + other.decision_squares,
            tuple(a + b for a, b in zip(self.bins, other.bins, strict=True)),
        )


@dataclass(frozen=True)
class Trend:
    """A straight line through weekly means.

    per_week: its slope.
    error: standard error of the slope.
    weeks: on how many it rests.
    """

    per_week: float
    error: float
    weeks: int

    @property
    def significant(self) -> bool:
        """The slope differs from zero by more than chance makes likely."""
        return abs(self.per_week) > SIGNIFICANT * self.error


def trend(moments: Sequence[float], means: Sequence[float], variances: Sequence[float]) -> Trend | None:
    """Fit a line to the weeks' means by weighted least squares; None with fewer than FEWEST_WEEKS weeks.

    If the means scatter about the line by more than their variances explain, the standard error grows accordingly, as
    weeks differ by more than chance.

    Args:
        moments: of the n weeks, in weeks.
        means, variances: the mean of each week, and the variance of that mean, over 0.
    """
    if len(moments) < FEWEST_WEEKS:
        return None
    x, y = np.asarray(moments, np.float64), np.asarray(means, np.float64)
    weights = 1.0 / np.asarray(variances, np.float64)
    total = weights.sum()
    centred = x - (weights @ x) / total
    spread = float(weights @ centred**2)
    if spread <= 0:
        return None
    slope = float(weights @ (centred * y)) / spread
    residuals = y - (weights @ y) / total - slope * centred
    excess = float(weights @ residuals**2) / (len(x) - 2)
    return Trend(slope, math.sqrt(max(1.0, excess) / spread), len(x))


def score_trend(weeks: Sequence[Week]) -> Trend | None:
    """The trend of the mean of the best scores, per week."""
    used = [week for week in weeks if week.compared >= FEWEST_QUERIES]
    means = [week.score / week.compared for week in used]
    variances = [
        max(week.score_squares / week.compared - mean**2, 1e-6) / week.compared
        for week, mean in zip(used, means, strict=True)
    ]
    return trend(_moments(used), means, variances)


def unknown_trend(weeks: Sequence[Week]) -> Trend | None:
    """The trend of the share of unknown answers, per week."""
    used = [week for week in weeks if week.queries >= FEWEST_QUERIES]
    # One answer of each kind is added (after Agresti and Coull): a week without unknown ones would have no variance.
    rates = [(week.unknown + 1) / (week.queries + 2) for week in used]
    variances = [rate * (1 - rate) / week.queries for rate, week in zip(rates, used, strict=True)]
    return trend(_moments(used), rates, variances)


def _moments(weeks: Sequence[Week]) -> list[float]:
    return [(week.monday - weeks[0].monday).days / 7 for week in weeks]
