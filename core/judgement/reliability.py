"""How well stated probabilities hold: reliability diagram, calibration error, Brier score, confidence intervals."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, Field

BINS = 10
"""Bins of a reliability diagram."""

CONFIDENCE = 0.95
"""Confidence of the intervals."""


class Share(BaseModel):
    """A share that was counted, with Wilson's interval: how far it may lie from the one that would be found in the
    long run."""

    value: float | None = Field(description="Null where nothing was counted.")
    low: float = Field(description="Lower end of the interval (95 %).")
    high: float = Field(description="Upper end of the interval (95 %).")
    count: int = Field(description="Of these …")
    of: int = Field(description="… this many.")


class Bin(BaseModel):
    """Answers whose probability lies between ``low`` and ``high``: the promised share, and the outcome."""

    low: float
    high: float
    probability: float = Field(description="Mean of the stated probabilities.")
    right: Share = Field(description="Share of the answers that were right.")


class Reliability(BaseModel):
    """The reliability of stated probabilities over n answers whose truth is known."""

    answers: int
    right: int
    ece: float = Field(description="Expected calibration error: mean over the answers of |promised - found| by bin.")
    brier: float = Field(description="Mean square of probability minus outcome; 0 is perfect.")
    brier_of_base_rate: float = Field(description="The same if every answer stated the share of right ones.")
    bins: list[Bin] = Field(description="The reliability diagram; bins without an answer are left out.")


def wilson(count: int, of: int, confidence: float = CONFIDENCE) -> Share:
    """A share and its confidence interval (Wilson, "Probable inference", JASA 22, 1927).

    With n = ``of``, p = count / n and z the normal quantile of the confidence, the interval is
    (p + z²/2n ± z √(p(1-p)/n + z²/4n²)) / (1 + z²/n).  It is sound for few observations and for shares near 0 and 1.

    Raises:
        ValueError: the count is negative or more than ``of``.
    """
    if not 0 <= count <= of:
        raise ValueError(f"{count} of {of} is no share")
    if of == 0:
        return Share(value=None, low=0.0, high=1.0, count=0, of=0)
    z, p = NormalDist().inv_cdf((1 + confidence) / 2), count / of
    centre, spread = p + z * z / (2 * of), z * np.sqrt(p * (1 - p) / of + z * z / (4 * of * of))
    scale = 1 + z * z / of
    # Rounding must not put a bound on the wrong side of the observed share.
    low, high = max(0.0, min(p, (centre - spread) / scale)), min(1.0, max(p, (centre + spread) / scale))
    return Share(value=p, low=float(low), high=float(high), count=count, of=of)


def brier(probabilities: ArrayLike, right: ArrayLike) -> float:
    """The mean square of probability minus outcome (Brier, 1950); both [n], n > 0."""
    return float(np.square(np.asarray(probabilities, np.float64) - np.asarray(right, np.float64)).mean())


def reliability(probabilities: ArrayLike, right: ArrayLike, bins: int = BINS) -> Reliability:
    """The reliability diagram over bins of equal width, and its figures.

    Args:
        probabilities: [n], n > 0, each in [0, 1].
        right: bool [n], whether each answer was right.

    Raises:
        ValueError: there is no answer, or a probability outside [0, 1].
    """
    p, y = np.asarray(probabilities, np.float64), np.asarray(right, np.bool_)
    if not len(p) or not ((p >= 0) & (p <= 1)).all():
        raise ValueError("reliability needs probabilities, each in [0, 1]")
    number: NDArray[np.int64] = np.minimum((p * bins).astype(np.int64), bins - 1)
    filled = []
    for index in np.unique(number):
        inside = number == index
        right_share = wilson(int(y[inside].sum()), int(inside.sum()))
        filled.append(
            Bin(low=index / bins, high=(index + 1) / bins, probability=float(p[inside].mean()), right=right_share)
        )
    error = sum(abs(one.probability - (one.right.value or 0.0)) * one.right.of for one in filled) / len(p)
    return Reliability(
        answers=len(p),
        right=int(y.sum()),
        ece=float(error),
        brier=brier(p, y),
        brier_of_base_rate=float(y.mean() * (1 - y.mean())),
        bins=filled,
    )
