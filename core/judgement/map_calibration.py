"""A calibration of a map's own, from trials on it: curve, margin, threshold, and what they are worth.

The curve and the margin come first; the threshold follows from what its owner wants.  What is reported of them is
measured by cross-validation: the frames are cut into blocks in the order in which they were taken, and each block is
judged by the calibration that the other blocks give, so no frame has a say in its own judgement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.errors import CalibrationImpossible
from core.judgement.curves import auc_pr, auc_roc, falling
from core.judgement.probability import Curve, fit_curve
from core.judgement.reliability import Reliability, Share, reliability, wilson
from core.judgement.trials import Flags, Trials, Values
from core.judgement.verdict import Calibration

FEWEST_OUTCOMES = 10
"""Right answers, and wrong ones, that a calibration rests on at least."""

LEAST_AREA = 0.6
"""Under the ROC of right against wrong answers: below it the decision value says too little to build on."""

LOST_BY_MARGIN = 0.02
"""The margin turns at most this share of right answers into ambiguous ones."""

BLOCKS = 5
MOST_POINTS = 101

Rule = Literal["precision", "false_accept_rate", "mean_of_negatives"]


class Target(BaseModel):
    """What the threshold is to reach.

    ``precision``: so many of the answers believed are right.  ``false_accept_rate``: at most so many of the frames of
    places that the map lacks are believed.  ``mean_of_negatives``: the rule of the thesis (3.4.3), the mean over
    the frames of places that the map lacks; it has no value.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    rule: Rule
    value: float | None = Field(default=None, gt=0, lt=1)

    @model_validator(mode="after")
    def _a_value_where_one_belongs(self) -> Target:
        if (self.value is None) != (self.rule == "mean_of_negatives"):
            raise ValueError("a value between 0 and 1 belongs to precision and to false_accept_rate, and to them only")
        return self


class Point(BaseModel):
    """What one threshold on the decision value does, on all frames; the margin is not applied."""

    threshold: float
    precision: float = Field(description="Right ones among the answers believed.")
    recall: float = Field(description="Right answers believed, of the frames whose place is in the map.")
    false_accept_rate: float | None = Field(description="Believed, of the frames whose place is not; null without any.")


class Held(BaseModel):
    """What the verdicts did with frames that had no part in the threshold by which they were judged."""

    precision: Share = Field(description="Right ones among the recognized.")
    recall: Share = Field(description="Recognized and right, of the frames whose place is in the map.")
    false_accept_rate: Share = Field(description="Recognized, of the frames whose place is not.")
    reliability: Reliability = Field(description="Of the probabilities.")


class Measurement(BaseModel):
    """What was measured in making a calibration."""

    frames: int = Field(description="Frames that were asked.")
    trials: int = Field(description="Queries: a frame is asked of the map with its place and of the map without it.")
    known: int = Field(description="Queries whose place was in the map.")
    unknown: int = Field(description="Queries whose place was not.")
    right: int = Field(description="Queries whose best match was right.")
    auc_pr: float = Field(description="Under the precision-recall curve; recall over right matches only.")
    auc_roc: float | None = Field(description="Queries with their place in the map against those without.")
    auc_roc_right: float = Field(description="Right answers against all others.")
    cross_validated: Held
    points: list[Point] = Field(description="The precision-recall and ROC curves, by rising threshold.")


@dataclass(frozen=True)
class Recalibration:
    """A calibration made of trials, and what was measured in making it."""

    calibration: Calibration
    measurement: Measurement


def recalibrate(trials: Trials, base: Calibration, target: Target, source: str) -> Recalibration:
    """A calibration of trials.

    Args:
        trials: judged with ``base``, whose background and kind of decision value are kept.
        source: said of the calibration.

    Raises:
        CalibrationImpossible: the trials are too few, the decision value hardly tells right from wrong,
            or no threshold reaches the target; the text says which.
    """
    _check(trials, target)
    calibration = _fitted(trials, base, target)
    frames = len(np.unique(trials.frame))
    known, right = trials.known, trials.right
    points = curve_points(trials.decision, known, right)
    measurement = Measurement(
        frames=frames,
        trials=len(trials),
        known=int(known.sum()),
        unknown=int((~known).sum()),
        right=int(right.sum()),
        auc_pr=auc_pr(trials.decision, right),
        auc_roc=auc_roc(trials.decision, known),
        auc_roc_right=auc_roc(trials.decision, right) or 0.0,
        cross_validated=cross_validated(trials, base, target),
        points=_thinned(points),
    )
    return Recalibration(calibration.model_copy(update={"source": source, "frames": frames}), measurement)


def blocks_of(frame: NDArray[np.int64], count: int = BLOCKS) -> list[Flags]:
    """The trials of each of ``count`` runs of consecutive frames, bool [n] each; fewer where there are fewer frames."""
    frames = np.unique(frame)
    runs = np.array_split(frames, min(count, len(frames)))
    return [np.isin(frame, run) for run in runs]


def cross_validated(trials: Trials, base: Calibration, target: Target) -> Held:
    """Each block judged by the calibration of the others.

    Raises:
        CalibrationImpossible: the others of a block do not make a calibration.
    """
    recognized, probabilities = np.zeros(len(trials), np.bool_), np.zeros(len(trials))
    for block in blocks_of(trials.frame):
        calibration = _fitted(trials.take(~block), base, target)
        held = trials.take(block)
        recognized[block], probabilities[block] = held.recognized(calibration), held.probabilities(calibration)
    return held_figures(trials, recognized, probabilities)


def held_figures(trials: Trials, recognized: Flags, probabilities: Values) -> Held:
    """The figures of verdicts and probabilities; all [n]."""
    passed, known = recognized & trials.right, trials.known
    return Held(
        precision=wilson(int(passed.sum()), int(recognized.sum())),
        recall=wilson(int(passed.sum()), int(known.sum())),
        false_accept_rate=wilson(int((recognized & ~known).sum()), int((~known).sum())),
        reliability=reliability(probabilities, trials.right),
    )


def curve_points(decision: Values, known: Flags, right: Flags) -> list[Point]:
    """What every threshold that makes a difference does, by rising threshold; all [n]."""
    order, ends = falling(decision)
    passed, rights = ends + 1, np.cumsum(right[order])[ends]
    strangers, unknown = np.cumsum(~known[order])[ends], int((~known).sum())
    return [
        Point(
            threshold=float(decision[order][end]),
            precision=float(rights[i] / passed[i]),
            recall=float(rights[i] / max(1, int(known.sum()))),
            false_accept_rate=float(strangers[i] / unknown) if unknown else None,
        )
        for i, end in enumerate(ends)
    ][::-1]


def _check(trials: Trials, target: Target) -> None:
    right, wrong = int(trials.right.sum()), int((~trials.right).sum())
    if min(right, wrong) < FEWEST_OUTCOMES:
        raise CalibrationImpossible(
            f"A calibration rests on at least {FEWEST_OUTCOMES} right and as many wrong answers; "
            f"here {right} are right and {wrong} wrong. Give more frames, of known and of unknown places."
        )
    strangers = int((~trials.known).sum())
    if target.rule != "precision" and strangers < FEWEST_OUTCOMES:
        raise CalibrationImpossible(
            f"This rule rests on at least {FEWEST_OUTCOMES} frames of places that the map lacks; here are {strangers}."
        )
    area = auc_roc(trials.decision, trials.right) or 0.0
    if area < LEAST_AREA:
        raise CalibrationImpossible(
            f"On this map right answers can hardly be told from wrong ones: the area under the ROC is {area:.2f}, "
            f"at least {LEAST_AREA} is needed. Other places, or another encoder, may do."
        )


def _fitted(trials: Trials, base: Calibration, target: Target) -> Calibration:
    """Curve, margin and threshold of trials."""
    try:
        curve = fit_curve(trials.decision, trials.right)
    except ValueError as error:
        raise CalibrationImpossible(f"No probability can be told: {error}.") from error
    margins = trials.margin[trials.right]
    margins = margins[np.isfinite(margins)]
    margin = max(0.0, float(np.quantile(margins, LOST_BY_MARGIN, method="lower"))) if len(margins) else 0.0
    threshold = _threshold(trials, curve, target)
    return base.model_copy(update={"curve": curve, "margin": margin, "threshold": threshold})


def _threshold(trials: Trials, curve: Curve, target: Target) -> float:
    """The lowest threshold that reaches the target by itself: the margin makes the verdicts stricter still."""
    if target.rule == "precision":
        assert target.value is not None
        return _for_precision(trials, curve, target.value)
    strangers = np.sort(trials.decision[~trials.known])[::-1]
    if not len(strangers):
        raise CalibrationImpossible("A part of the frames has none of a place that the map lacks; mix them.")
    if target.rule == "mean_of_negatives":
        return float(strangers.mean())
    assert target.value is not None
    # What equals the threshold passes, so it lies just above the last one to be kept out.
    return float(np.nextafter(strangers[int(target.value * len(strangers))], np.inf))


def _for_precision(trials: Trials, curve: Curve, wanted: float) -> float:
    """The lowest decision value above which so many answers are right, as counted and as the curve expects.

    Counts alone follow the luck of a few frames: of many thresholds some look better than they are.
    """
    order = np.argsort(-trials.decision, kind="stable")
    passed = np.arange(1, len(trials) + 1)
    counted = np.cumsum(trials.right[order]) / passed
    expected = np.cumsum(curve.probabilities(trials.decision[order])) / passed
    last = np.append(np.diff(trials.decision[order]) != 0, True)
    reached = np.flatnonzero((counted >= wanted) & (expected >= wanted) & last)
    if not len(reached):
        best = float(np.minimum(counted, expected)[last].max())
        raise CalibrationImpossible(
            f"No threshold lets {wanted:.1%} of the answers believed be right: the best that {len(trials)} answers "
            f"can promise is {best:.1%}. More frames promise more, where all that is believed is right."
        )
    return float(trials.decision[order][reached[-1]])


def _thinned(points: list[Point]) -> list[Point]:
    """At most MOST_POINTS of them, spread evenly, the first and the last among them."""
    chosen = np.unique(np.linspace(0, len(points) - 1, min(MOST_POINTS, len(points))).round().astype(int))
    return [points[index] for index in chosen]
