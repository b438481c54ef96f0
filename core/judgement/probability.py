"""From a decision value to the probability that the best match is right, and back.

The curve is logistic, P(right | d) = 1 / (1 + exp(-(slope · d + intercept))), and fitted by maximum likelihood to
answers whose truth is known (Platt, "Probabilistic outputs for support vector machines", 1999).  Its two parameters
can be fitted to few frames without following their noise.  As it rises everywhere, thresholds on the decision value
and on the probability are equivalent.

In a small map a decision value says less, as much of the background that it rests on is imagined (``background.py``).
With the share u of imagined places, slope and intercept are slope + u · imagined_slope and
intercept + u · imagined_intercept.  Both are fitted to maps of 1 to 30 places that were cut from real traverses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

FARTHEST = 35.0
"""Log odds are limited to this: beyond it 1 - P would be lost in rounding, and no measurement is as certain."""

STRETCH, SHIFT = 0.5, 2.0
"""How much the curve of a new environment may differ from a known one: the deviations of the logarithm of the factor of
its log odds, and of what is added to them."""

NEWTON_STEPS = 100
"""At most this many iterations fit a curve."""


class Curve(BaseModel):
    """P(right | d) = 1 / (1 + exp(-(slope · d + intercept))), d a decision value."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    slope: float = Field(gt=0, allow_inf_nan=False, description="Log odds gained by a decision value greater by one.")
    intercept: float = Field(allow_inf_nan=False, description="Log odds at the decision value 0.")
    imagined_slope: float = Field(
        default=0.0,
        exclude_if=lambda value: value == 0,
        allow_inf_nan=False,
        description="Added to the slope where the whole background is imagined; left out if 0.",
    )
    imagined_intercept: float = Field(
        default=0.0,
        exclude_if=lambda value: value == 0,
        allow_inf_nan=False,
        description="Added to the intercept where the whole background is imagined; left out if 0.",
    )

    @model_validator(mode="after")
    def _rises_in_any_map(self) -> Curve:
        if self.slope + self.imagined_slope <= 0:
            raise ValueError("slope and imagined_slope add up to more than 0")
        return self

    def log_odds(self, decisions: ArrayLike, imagined: ArrayLike = 0.0) -> NDArray[np.float64]:
        """The log odds for decision values of any shape, given the shares of imagined places, each in [0, 1]."""
        d, share = np.asarray(decisions, np.float64), np.asarray(imagined, np.float64)
        slope, intercept = self.slope + share * self.imagined_slope, self.intercept + share * self.imagined_intercept
        return np.asarray(slope * d + intercept, np.float64)

    def probability(self, decision: float, imagined: float = 0.0) -> float:
        """The probability for one decision value, in (0, 1)."""
        return float(self.probabilities([decision], imagined)[0])

    def probabilities(self, decisions: ArrayLike, imagined: ArrayLike = 0.0) -> NDArray[np.float64]:
        """The probabilities for decision values of any shape, each in (0, 1)."""
        return sigmoid(self.log_odds(decisions, imagined))

    def decision(self, probability: float) -> float:
        """The decision value for a probability in (0, 1), where nothing is imagined."""
        return float((np.log(probability) - np.log1p(-probability) - self.intercept) / self.slope)


def sigmoid(log_odds: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 / (1 + exp(-x)), in (0, 1) for any finite x."""
    return np.asarray(1 / (1 + np.exp(-np.clip(log_odds, -FARTHEST, FARTHEST))), np.float64)


def fit_curve(decisions: ArrayLike, right: ArrayLike, shares: ArrayLike | None = None) -> Curve:
    """Fit the curve under which the outcomes are most likely.

    The targets are (N₊ + 1) / (N₊ + 2) and 1 / (N₋ + 2), as Platt proposes, as if one more outcome of each kind had
    been seen; so outcomes that a threshold separates give a finite slope.

    Args:
        decisions: [n], decision values.
        right: bool [n], whether the best match was right.
        shares: [n], over 0, the weight of each outcome; None: all weigh the same.

    Raises:
        ValueError: all answers are right or all are wrong, or right answers do not have higher decision values.
    """
    d, y = np.asarray(decisions, np.float64), np.asarray(right, np.bool_)
    positive, negative = int(y.sum()), int((~y).sum())
    if not positive or not negative:
        raise ValueError("a curve needs right and wrong answers")
    scale = float(d.std())
    if scale == 0:
        raise ValueError("all decision values are the same")
    counted = np.ones(len(d)) if shares is None else np.asarray(shares, np.float64) * (len(d) / np.sum(shares))
    targets = np.where(y, (positive + 1) / (positive + 2), 1 / (negative + 2))
    design = np.stack([(d - d.mean()) / scale, np.ones_like(d)], axis=1)
    weights = np.array([0.0, np.log((positive + 1) / (negative + 1))])
    for _ in range(NEWTON_STEPS):
        p = sigmoid(design @ weights)
        curvature = (design * (counted * p * (1 - p))[:, None]).T @ design + 1e-9 * np.eye(2)
        step = np.linalg.solve(curvature, design.T @ (counted * (p - targets)))
        loss = _loss(design, weights, targets, counted)
        while _loss(design, weights - step, targets, counted) > loss and np.abs(step).max() > 1e-12:
            step = step / 2
        weights = weights - step
        if np.abs(step).max() < 1e-9:
            break
    slope = float(weights[0] / scale)
    if not slope > 0:
        raise ValueError("right answers do not have higher decision values than wrong ones")
    return Curve(slope=slope, intercept=float(weights[1] - slope * d.mean()))


def _loss(
    design: NDArray[np.float64],
    weights: NDArray[np.float64],
    targets: NDArray[np.float64],
    counted: NDArray[np.float64],
) -> float:
    """The negative log-likelihood."""
    odds = design @ weights
    return float((counted * (np.logaddexp(0, odds) - targets * odds)).sum())


def moved_curve(
    curve: Curve,
    decisions: ArrayLike,
    imagined: ArrayLike,
    right: ArrayLike,
    factors: ArrayLike,
    down: bool = False,
) -> Curve:
    """A curve whose log odds are stretched and shifted as far as outcomes demand it, but no farther.

    Args:
        decisions: [n], decision values; imagined: [n], shares of imagined places.
        right, factors, down: as of :func:`movement`.
    """
    stretch, shift = movement(curve.log_odds(decisions, imagined), right, factors, down)
    return Curve(
        slope=stretch * curve.slope,
        intercept=stretch * curve.intercept + shift,
        imagined_slope=stretch * curve.imagined_slope,
        imagined_intercept=stretch * curve.imagined_intercept,
    )


def movement(log_odds: ArrayLike, right: ArrayLike, factors: ArrayLike, down: bool = False) -> tuple[float, float]:
    """The most probable stretch a and shift b of log odds, a · odds + b, given the outcomes.

    Before them log a and b are normal about 0 with the deviations ``STRETCH`` and ``SHIFT``.  So few outcomes move log
    odds little, and even outcomes of one kind only are enough.

    Args:
        log_odds: [n], that an answer is right, before rivals under the margin take from them.
        right: bool [n], whether the best match was right.
        factors: [n], in (0, 1], by which the probability of the log odds is multiplied to be that of the answer.
        down: only shift them, and only down: a is 1, and b at most 0.
    """
    from scipy.optimize import minimize  # here, because it takes long to import

    odds, y, share = np.asarray(log_odds, np.float64), np.asarray(right, np.bool_), np.asarray(factors, np.float64)

    def loss(moved: NDArray[np.float64]) -> float:
        stated = share * sigmoid(np.exp(moved[0]) * odds + moved[1])
        likelihood = np.where(y, np.log(stated), np.log1p(-stated)).sum()
        return float((moved[0] / STRETCH) ** 2 / 2 + (moved[1] / SHIFT) ** 2 / 2 - likelihood)

    options = {"xatol": 1e-6, "fatol": 1e-9, "maxiter": 2000}
    if down:
        found = minimize(
            lambda b: loss(np.array([0.0, -abs(b[0])])), np.zeros(1), method="Nelder-Mead", options=options
        )
        return 1.0, -abs(float(found.x[0]))
    found = minimize(loss, np.zeros(2), method="Nelder-Mead", options=options)
    return float(np.exp(found.x[0])), float(found.x[1])
