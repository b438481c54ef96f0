"""The verdict on a query, recognized, ambiguous or unknown, from its scores against a map.

Scores J / V of different maps and conditions cannot be compared, so the best score is compared with the others of the
same map.  The decision value is the geometric mean of the best score s and of its lead over the best other places that
were examined as closely,

    d = √(s · (s - mean of the five best other places)).

Neither factor is enough alone: in a map whose places all look alike, unknown places score high, too, and where nothing
looks alike a low score leads.  Only the top of the ranking is needed, so that the value is the same whether all of a
map was scored or a shortlist.  As a map of a few places says little about others, imagined places are added to it;
their scores are those of unrelated frames when the encoder was calibrated.

The calibration's curve turns a decision value into a probability (``probability.py``).  Of two places that score alike
at most one is right, so that

    P = curve(d) · (½ + ½ min(1, m / m₀)),

with the lead m over the best rival and the margin m₀ under which an answer is ambiguous: without a lead, half of the
probability is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from core.judgement.probability import Curve
from core.places import Neighborhood, Whereabouts

Verdict = Literal["recognized", "ambiguous", "unknown"]

TOP_PLACES = 5
"""The best score is compared with the mean of this many of the best other places; imagined ones are added to fewer."""


class Calibration(BaseModel):
    """When to believe a match; measured on frames held out of training.

    ``threshold`` is on the decision value, ``margin`` on the difference of
    two scores.  ``background_mean`` and ``background_deviation`` describe the score of unrelated
    frames, in units of the score.  ``curve`` tells how probable a decision value is right; a calibration on
    frames that are all alike has none.  ``decision`` names the decision value, of which there is one.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str = Field(min_length=1, examples=["encoder-default"])
    threshold: float = Field(allow_inf_nan=False)
    margin: float = Field(ge=0, allow_inf_nan=False)
    background_mean: float = Field(allow_inf_nan=False)
    background_deviation: float = Field(gt=0, allow_inf_nan=False)
    curve: Curve | None = None
    decision: Literal["leading"] = "leading"
    frames: int | None = Field(default=None, ge=1, description="Held-out or labelled frames it rests on, if known.")


@dataclass(frozen=True)
class Judgement:
    """A verdict and the values that it rests on; None for values that do not exist.

    score: of the best match.
    decision: the decision value.
    margin: the lead over the best rival.
    rival: the position of the best rival in the ranking.
    probability: that the best match is right; None for an empty map, and for a calibration without a curve.
    """

    verdict: Verdict
    score: float | None
    decision: float | None
    margin: float | None
    rival: int | None
    probability: float | None = None


def filled_up(scores: NDArray[np.float32], calibration: Calibration) -> NDArray[np.float64]:
    """Add the scores of imagined places to those of other places until there are ``TOP_PLACES``.

    Args:
        scores: float32 [n], n >= 0, best first.

    Returns:
        float64 [max(n, TOP_PLACES)], best first.
    """
    missing = TOP_PLACES - len(scores)
    if missing <= 0:
        return scores.astype(np.float64)
    quantiles = np.array([NormalDist().inv_cdf((i + 0.5) / missing) for i in range(missing)])
    imagined = calibration.background_mean + calibration.background_deviation * quantiles
    return np.sort(np.concatenate([scores, imagined]))[::-1]


def leading(best: float, rest: NDArray[np.float32], calibration: Calibration) -> float:
    """The decision value √(best · (best - mean of the top of the rest)); 0 if a factor is negative.

    Args:
        best: the best score.
        rest: float32 [n], n >= 0, best first: the scores of places other than the best match's that the second stage
            has examined, too, if there is one.
        calibration: has the scores of imagined places.
    """
    scores = filled_up(rest, calibration)
    return float(np.sqrt(max(0.0, best) * max(0.0, best - scores[:TOP_PLACES].mean())))


def probability_of(decision: float, margin: float | None, calibration: Calibration) -> float | None:
    """The probability that the best match is right, by the calibration's curve and the lead over the best rival.

    Args:
        decision: the decision value.
        margin: the lead over the best rival, at least 0; None without a rival.

    Returns:
        In (0, 1); None if the calibration has no curve.
    """
    if calibration.curve is None:
        return None
    clear = 1.0
    if margin is not None:
        clear = min(1.0, max(0.0, margin) / calibration.margin) if calibration.margin else float(margin > 0)
    return calibration.curve.probability(decision) * (1 + clear) / 2


def judge(
    scores: NDArray[np.float32],
    whereabouts: Whereabouts,
    calibration: Calibration,
    neighborhood: Neighborhood,
    examined: int | NDArray[np.bool_] = 0,
) -> Judgement:
    """Judge one query.

    Args:
        scores: float32 [n], best first: of the query against all places of the map, or against the best of them.
        whereabouts: of the same n places in the same order.
        calibration: of the map or of the encoder.
        neighborhood: which places are the same place and so no rivals of each other.
        examined: which of the places the encoder's second stage has examined, bool [n], or how many of the first;
            0: it has no second stage.

    Returns:
        ``unknown`` for an empty map and for a decision value under the threshold, ``ambiguous`` for a lead over the
        best rival under the margin, else ``recognized``.
    """
    if len(scores) == 0:
        return Judgement("unknown", None, None, None, None)
    best = float(scores[0])
    others = np.flatnonzero(~whereabouts.near(0, neighborhood))
    closely = others[others < examined] if isinstance(examined, int) else others[examined[others]]
    decision = leading(best, scores[closely if np.any(examined) else others], calibration)
    rival = int(others[0]) if len(others) else None
    margin = None if rival is None else best - float(scores[rival])
    verdict: Verdict = "recognized"
    if decision < calibration.threshold:
        verdict = "unknown"
    elif margin is not None and margin < calibration.margin:
        verdict = "ambiguous"
    return Judgement(verdict, best, decision, margin, rival, probability_of(decision, margin, calibration))
