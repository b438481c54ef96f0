"""The background of a query: how the other places of the map score, and others that the map does not have yet.

Whether a best score stands out is seen by the scores of other places of the same environment.  A map of a few places
has few of them, and often only neighbours of the best match.  So such a map is filled up with imagined places, until
there are ``FULL`` other places.  How they score is estimated from what the query scores at the places that there are,
shrunk towards the scores of other places in the environments of the training data.  Places so near the best match that
both may show the same things teach nothing about the others and are left out of the estimate (``GUARD_FACTOR``).

Within one environment the scores of other places are taken as normal, with a mean μ and a variance σ² that differ from
environment to environment and are unknown.  Their conjugate prior is σ² ~ Scaled-Inv-χ²(ν₀, σ₀²) and
μ | σ² ~ N(μ₀, σ²/κ₀).  After k scores with the mean x̄ and the sum of squared deviations S,

    κ = κ₀ + k,   ν = ν₀ + k,   μ' = (κ₀ μ₀ + k x̄) / κ,   ν σ'² = ν₀ σ₀² + S + (κ₀ k / κ) (x̄ - μ₀)²,

and a further place is expected to score μ' with the variance σ'² (1 + 1/κ) (Gelman et al., Bayesian Data Analysis, 3rd
edition, section 3.3).  The imagined places have evenly spaced quantiles of the normal distribution with these moments.
In a map of one place they are spread as widely as environments differ, and only a very high score stands out; with each
further place the map's own scores count more, and with FULL of them nothing is imagined.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

Values = NDArray[np.float64]

TOP_PLACES = 5
"""The best score is compared with the mean of this many of the best other places."""

FULL = 60
"""A map with this number of other places gets no imagined ones.  With 60, the default threshold recognizes 5.2 % of the
strangers in maps of 1 to 30 frames of nordland_tiny and camvid; with 50 it is 6.0 %, with 40 6.7 %, with 30 8.5 %.
Corridor had a say in it as well: there it is the least of these with which no size has more than 5 %."""


GUARD_FACTOR = 3
"""Only places farther from the best match than this multiple of the same-place distance count as other places."""

LOWEST_DECISION, HIGHEST_DECISION = -1.0, 1.0
"""No score is over 1, so that every decision value is between these, except for rounding (``Background.decision``)."""


class Environment(BaseModel):
    """The prior of the scores of other places of one environment, in units of the score (see the module).

    ``mean`` and ``deviation`` are μ₀ and σ₀; ``mean_weight`` and ``deviation_weight`` are κ₀ and ν₀, the number of
    scores that the prior counts as.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    mean: float = Field(allow_inf_nan=False)
    deviation: float = Field(gt=0, allow_inf_nan=False)
    mean_weight: float = Field(gt=0, allow_inf_nan=False)
    deviation_weight: float = Field(gt=0, allow_inf_nan=False)

    def further(self, scores: Values) -> tuple[float, float]:
        """The expected score of a further place and its standard deviation, after ``scores``, float64 [k], k >= 0."""
        k = len(scores)
        weight, freedom = self.mean_weight + k, self.deviation_weight + k
        mean, squares = self.mean, self.deviation_weight * self.deviation**2
        if k:
            seen = float(scores.mean())
            squares += float(np.square(scores - seen).sum()) + self.mean_weight * k / weight * (seen - mean) ** 2
            mean = (self.mean_weight * mean + k * seen) / weight
        return mean, float(np.sqrt(squares / freedom * (1 + 1 / weight)))


@dataclass(frozen=True)
class Background:
    """The scores of other places, those imagined included.

    scores: float64 [n], n >= TOP_PLACES, best first.
    imagined: the share of FULL other places that had to be imagined, from 0 to 1.
    """

    scores: Values
    imagined: float

    @property
    def top(self) -> float:
        """The mean of the best few."""
        return float(self.scores[:TOP_PLACES].mean())

    def decision(self, best: float) -> float:
        """The decision value √(s · (s - top)) of a best score s; where s is under the top, -√(top · (top - s)).

        So it rises with s everywhere.  A score under 0 counts as 0.
        """
        s, top = max(0.0, best), max(0.0, self.top)
        return float(np.sqrt(s * (s - top))) if s >= top else -float(np.sqrt(top * (top - s)))


def background(
    scores: NDArray[np.floating], apart: NDArray[np.floating], others: int, environment: Environment
) -> Background:
    """The background of a query in a map.

    Args:
        scores: float [n], n >= 0, best first: of other places that were examined as closely as the best match.
        apart: float [m], m <= n: those of them that are of places beyond GUARD_FACTOR.
        others: how many other places the map has, at least n.
    """
    missing = max(0, FULL - max(others, len(scores)), TOP_PLACES - len(scores))
    known = np.asarray(scores, np.float64)
    if not missing:
        return Background(known, 0.0)
    mean, deviation = environment.further(np.asarray(apart, np.float64))
    every = np.concatenate([known, mean + deviation * _quantiles(missing)])
    return Background(np.sort(every)[::-1], missing / FULL)


def unrelated(scores: NDArray[np.floating], mean: float, deviation: float) -> Background:
    """The background by a calibration without an environment, as those of encoders of one's own are.

    Imagined places, as many as are missing to ``TOP_PLACES``, score like places of different environments.
    """
    known = np.asarray(scores, np.float64)
    missing = max(0, TOP_PLACES - len(known))
    every = np.concatenate([known, mean + deviation * _quantiles(missing)]) if missing else known
    return Background(np.sort(every)[::-1], 0.0)


@cache
def _quantiles(count: int) -> Values:
    """Evenly spaced quantiles of the standard normal distribution, float64 [count]."""
    return np.array([NormalDist().inv_cdf((i + 0.5) / count) for i in range(count)])
