"""Recognized, ambiguous or unknown: what the scores of one query against a map amount to.

The raw score J / V does not travel between maps and conditions, so it is judged against the rest
of the map.  The decision value is the geometric mean of the best score and of its lead over the best
others that were examined as closely, d = √(s · (s - mean of the five best other places)), for neither is
enough alone: in a map whose places are all alike strangers score high as well, and where nothing is
alike a small score leads.  It asks for the top of the ranking only, so it is the same whether all of a map
was scored or a shortlist.  A map of a few places says little about others, so it is filled up with
imagined places that score as unrelated frames did when the encoder was made.

A decision value becomes a probability by the calibration's curve (``probability.py``).  Of two places that
score alike one is right at most: P = curve(d) · (½ + ½ min(1, m / m₀)), m the lead over the best rival and m₀
the margin under which an answer is ambiguous, so that half of it is left where there is no lead.
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

FEWEST_PLACES = 16
"""Maps with fewer places that are no match are filled up to this with imagined ones."""

TOP_PLACES = 5
"""The best score is held against the mean of so many of the best others."""


class Calibration(BaseModel):
    """When to believe a match; measured on frames held out of training.

    ``threshold`` is on the decision value, ``margin`` on the difference of
    two scores.  ``background_mean`` and ``background_deviation`` describe the score of unrelated
    frames, in units of the score.  ``curve`` tells how probable a decision value is right; calibrations
    made before there was one have none.  They are ``by-stage``, too: their decision value is
    ``leading`` only after a second stage, and ``standing_out`` where there is none.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str = Field(min_length=1, examples=["encoder-default"])
    threshold: float = Field(allow_inf_nan=False)
    margin: float = Field(ge=0, allow_inf_nan=False)
    background_mean: float = Field(allow_inf_nan=False)
    background_deviation: float = Field(gt=0, allow_inf_nan=False)
    curve: Curve | None = None
    decision: Literal["leading", "by-stage"] = "by-stage"
    frames: int | None = Field(default=None, ge=1, description="Held-out or labelled frames it rests on, if known.")


def completed(own: Calibration | None, default: Calibration, second_stage: bool) -> Calibration:
    """A map's own calibration, or its encoder's; one made before there were curves borrows the encoder's.

    Args:
        second_stage: of the encoder; without one the decision values of such a calibration are others than those
            that the encoder's curve is for, and it stays without.
    """
    if own is None:
        return default
    if own.curve is not None or not second_stage or own.decision == default.decision:
        return own
    return own.model_copy(update={"curve": default.curve, "decision": default.decision})


@dataclass(frozen=True)
class Judgement:
    """A verdict and what it rests on; scores in the units of the encoder's score."""

    verdict: Verdict
    score: float | None
    decision: float | None
    margin: float | None
    rival: int | None
    """Position of the best rival in the ranking."""
    probability: float | None = None
    """That the best match is right; None for an empty map and a calibration without a curve."""


def filled_up(scores: NDArray[np.float32], fewest: int, calibration: Calibration) -> NDArray[np.float64]:
    """At least ``fewest`` scores of other places, best first: the missing ones are those of imagined places.

    Args:
        scores: float32 [n], n >= 0, best first.
    """
    missing = fewest - len(scores)
    if missing <= 0:
        return scores.astype(np.float64)
    quantiles = np.array([NormalDist().inv_cdf((i + 0.5) / missing) for i in range(missing)])
    imagined = calibration.background_mean + calibration.background_deviation * quantiles
    return np.sort(np.concatenate([scores, imagined]))[::-1]


def standing_out(best: float, rest: NDArray[np.float32], calibration: Calibration, is_part: bool = False) -> float:
    """The decision value of older calibrations of one stage, in standard deviations of the rest.

    It is (best - mean of the top of the rest) / standard deviation of the rest.

    The best few of the rest grow with the number of places just as the best score of an unknown
    place does, so the value means the same on a small map and on a large one.

    Args:
        best: the best score.
        rest: float32 [n], n >= 0, best first: the scores of places that are not the best one's place.
        calibration: says how the imagined places score.
        is_part: ``rest`` are only the best; their spread is not that of all, for which the encoder's own stands in.
    """
    scores = filled_up(rest, FEWEST_PLACES, calibration)
    if is_part:
        return float((best - scores[:TOP_PLACES].mean()) / calibration.background_deviation)
    # Equal scores throughout would make any difference infinite; the encoder's own spread bounds it.
    spread = max(float(scores.std()), 0.1 * calibration.background_deviation)
    return float((best - scores[:TOP_PLACES].mean()) / spread)


def leading(best: float, rest: NDArray[np.float32], calibration: Calibration) -> float:
    """The decision value: √(best · (best - mean of the top of the rest)); 0 if negative.

    Args:
        best: the best score.
        rest: float32 [n], n >= 0, best first: of places that are not the best one's place and were compared as
            closely: examined by the second stage, if there is one.
        calibration: says how the imagined places score.
    """
    scores = filled_up(rest, TOP_PLACES, calibration)
    return float(np.sqrt(max(0.0, best) * max(0.0, best - scores[:TOP_PLACES].mean())))


def probability_of(decision: float, margin: float | None, calibration: Calibration) -> float | None:
    """That the best match is right: by the calibration's curve, shared with a rival that scores alike.

    Args:
        margin: lead over the best rival, at least 0; None without a rival.

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
    is_part: bool = False,
) -> Judgement:
    """The verdict on one query.

    Args:
        scores: float32 [n], best first: the query against every place of the map, or against the best of them.
        whereabouts: of the same n places in the same order.
        calibration: thresholds of the map or of the encoder.
        neighborhood: which places are no rivals of each other.
        examined: which of the places the encoder's second stage has examined, bool [n], or how many of the first;
            0: it has none.
        is_part: the scores are those of the best places alone.

    Returns:
        ``unknown`` for an empty map and for a decision value under the threshold, ``ambiguous``
        for a margin to the best rival under its limit, else ``recognized``.
    """
    if len(scores) == 0:
        return Judgement("unknown", None, None, None, None)
    best = float(scores[0])
    others = np.flatnonzero(~whereabouts.near(0, neighborhood))
    closely = others[others < examined] if isinstance(examined, int) else others[examined[others]]
    second_stage = bool(np.any(examined))
    if second_stage or calibration.decision == "leading":
        decision = leading(best, scores[closely if second_stage else others], calibration)
    else:
        decision = standing_out(best, scores[others], calibration, is_part)
    rival = int(others[0]) if len(others) else None
    margin = None if rival is None else best - float(scores[rival])
    verdict: Verdict = "recognized"
    if decision < calibration.threshold:
        verdict = "unknown"
    elif margin is not None and margin < calibration.margin:
        verdict = "ambiguous"
    return Judgement(verdict, best, decision, margin, rival, probability_of(decision, margin, calibration))
