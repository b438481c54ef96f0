"""Calibrations: how a curve, a threshold and a margin are fitted from trials, for an encoder or for one map.

A calibration says when an answer is believed (see ``verdict.py``).  An encoder ships with one, fitted here from frames
that were held out of its training (:func:`fit_encoder_calibration`).  A map may get one of its own, fitted from
queries whose true place is known (:func:`fit_map_calibration`).  In both, the curve and the margin come from the
trials; the threshold follows from what it is to achieve.

The figures reported with a map's calibration are cross-validated: the frames are cut into blocks in the order in
which they were taken, and each block is judged by a calibration fitted to the other blocks, so that no frame
influences its own judgement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.errors import CalibrationImpossible
from core.judgement.curves import auc_pr, auc_roc, falling
from core.judgement.geometry import TERMS, GeometryTerms, share_of_lead
from core.judgement.probability import Curve, fit_curve, moved_curve, movement
from core.judgement.reliability import Reliability, Share, reliability, wilson
from core.judgement.trials import Flags, StagedTrials, Trial, Trials, Values, gathered, joined
from core.judgement.verdict import Calibration, Judgement, judge, share_of_leads
from core.places import Neighborhood, Whereabouts

Scores = NDArray[np.float32]

LOST_BY_MARGIN = 0.02
"""The margin turns at most this share of the right answers into ambiguous ones."""

FALSE_ACCEPTS = 0.10
"""The threshold of an encoder's calibration accepts at most this share of the unknown places."""

SMALLEST_DEVIATION = 1e-6
"""Lower bound of the background's standard deviation, in units of the score; identical frames would give zero."""

FEWEST_OUTCOMES = 10
"""A map's calibration needs at least this many right and this many wrong answers."""

FEWEST_OF_A_KIND = 3
"""Frames of places of the map, and strangers, that trials need to tell how probable an answer is.  Those of one kind do
not: they were chosen by what they show, and of known places alone nearly all answers are right, whatever strangers
get."""

LEAST_AREA = 0.6
"""Least area under the ROC of right against wrong answers; below it the decision value hardly separates them."""

BLOCKS = 5
"""Blocks of the cross-validation."""

LOWEST, HIGHEST, THRESHOLDS = 0.3, 0.99, 50
"""The probabilities that a threshold demands, and how many thresholds are tried for a target."""

MOST_POINTS = 101
"""A reported curve has at most this many points."""


def fit_encoder_calibration(unknown: Scores, known: Scores, neighbours: int, source: str) -> Calibration:
    """Fit a calibration for an encoder to n frames in the order in which they were taken.

    Every frame is a query twice: as it is, against the frames that are not its neighbours (an unknown place), and as
    a second look (:func:`second_look`), against all frames (a known place).  Real second visits differ by more than
    a second look does, so the probabilities come out too high.  The packaged encoders are calibrated on real second
    visits; a map that matters deserves a calibration of its own (:func:`fit_map_calibration`).

    Args:
        unknown: float32 [n, n], the scores of the frames against each other.
        known: float32 [n, n], row i holds the scores of frame i's second look against all frames.
        neighbours: frames at most this many positions apart may show the same place.
        source: recorded in the calibration.

    Raises:
        ValueError: the frames are so few that all are neighbours of each other.
    """
    n = len(unknown)
    index = np.arange(n)
    apart = np.abs(index[:, None] - index[None, :]) > neighbours
    if not apart.any():
        raise ValueError(f"{n} frames are too few to calibrate on")
    unrelated = unknown[apart]
    start = Calibration(
        source=source,
        threshold=0.0,
        margin=0.0,
        background_mean=float(unrelated.mean()),
        background_deviation=max(SMALLEST_DEVIATION, float(unrelated.std())),
        decision="leading",
        frames=n,
        geometry=TERMS,
    )
    same_place = Neighborhood(radius=0.0, frames=neighbours)
    strangers = gathered(
        Trial(_judged(unknown[i], np.flatnonzero(apart[i]), start, same_place), False, False, i)
        for i in range(n)
        if apart[i].any()
    )
    looks = gathered(
        Trial(_judged(known[i], index, start, same_place), True, bool(np.argmax(known[i]) == i), i) for i in range(n)
    )
    threshold = _just_above(np.quantile(strangers.decision, 1 - FALSE_ACCEPTS, method="higher"))
    margin = _margin(looks.margin[looks.right & (looks.decision >= threshold)], "linear")
    trials = joined([strangers, looks], same_frames=True)
    try:
        curve = fit_curve(trials.decision, trials.right)
    except ValueError:  # the frames are all alike, so that no curve can be fitted
        curve = None
    return start.model_copy(update={"threshold": threshold, "margin": margin, "curve": curve})


def _judged(
    scores: Scores, places: NDArray[np.int64], calibration: Calibration, neighborhood: Neighborhood
) -> Judgement:
    """The judgement of one query against a map of the frames ``places``."""
    order = places[np.argsort(-scores[places], kind="stable")]
    return judge(scores[order], Whereabouts.along_sequence(order), calibration, neighborhood)


def _just_above(decision: float) -> float:
    """The lowest threshold that rejects a decision value; one equal to the threshold would be accepted."""
    return float(np.nextafter(decision, np.inf))


def _margin(margins: Values, method: Literal["linear", "lower"]) -> float:
    """The margin that loses the share LOST_BY_MARGIN of right answers, given their leads over their best rivals."""
    finite = margins[np.isfinite(margins)]
    return max(0.0, float(np.quantile(finite, LOST_BY_MARGIN, method=method))) if len(finite) else 0.0


Rule = Literal["precision", "false_accept_rate", "mean_of_negatives"]


class Target(BaseModel):
    """The target of the threshold.

    ``precision``: the share of right answers among those believed.  ``false_accept_rate``: the share of frames of
    places that the map lacks that may be believed.  ``mean_of_negatives``: rule of the thesis (3.4.3), the mean over
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
    """The effect of one threshold on the decision value of two stages, on all frames; the margin is not applied."""

    threshold: float
    precision: float = Field(description="Right ones among the answers believed.")
    recall: float = Field(description="Right answers believed, of the frames whose place is in the map.")
    false_accept_rate: float | None = Field(description="Believed, of the frames whose place is not; null without any.")


class Held(BaseModel):
    """The verdicts on held-out frames: those that had no part in the threshold by which they were judged."""

    precision: Share = Field(description="Right ones among the recognized.")
    recall: Share = Field(description="Recognized and right, of the frames whose place is in the map.")
    false_accept_rate: Share = Field(description="Recognized, of the frames whose place is not.")
    reliability: Reliability = Field(description="Of the probabilities.")


class Mix(BaseModel):
    """How many queries had each verdict."""

    recognized: int
    ambiguous: int
    unknown: int


class Effect(BaseModel):
    """The effect of a calibration on queries whose truth is known.

    The calibration may have been fitted to the same queries, so these figures are a little too good; those of
    :class:`Measurement` are cross-validated.  A best match that does not stand out counts as unknown, also where rivals
    explain it.
    """

    threshold: float
    margin: float
    verdicts: Mix
    precision: Share = Field(description="Right ones among the recognized.")
    recall: Share = Field(description="Recognized and right, of the queries whose place is in the map.")
    false_accept_rate: Share = Field(description="Recognized, of the queries whose place is not.")
    reliability: Reliability | None = Field(description="Of the probabilities; null for a calibration without a curve.")


def effect_of(trials: Trials, calibration: Calibration) -> Effect:
    """The effect of a calibration on some trials, at least one."""
    recognized, believed = trials.recognized(calibration), trials.standing_out(calibration)
    passed, known = recognized & trials.right, trials.known
    stated = None
    if calibration.curve is not None:
        stated = reliability(trials.probabilities(calibration), trials.right)
    return Effect(
        threshold=calibration.threshold,
        margin=calibration.margin,
        verdicts=Mix(
            recognized=int(recognized.sum()),
            ambiguous=int((believed & ~recognized).sum()),
            unknown=int((~believed).sum()),
        ),
        precision=wilson(int(passed.sum()), int(recognized.sum())),
        recall=wilson(int(passed.sum()), int(known.sum())),
        false_accept_rate=wilson(int((recognized & ~known).sum()), int((~known).sum())),
        reliability=stated,
    )


class Measurement(BaseModel):
    """The measurements made for a calibration."""

    frames: int = Field(description="Frames that were queried.")
    trials: int = Field(description="Queries: each frame queries the map with its place and the map without it.")
    known: int = Field(description="Queries whose place was in the map.")
    unknown: int = Field(description="Queries whose place was not.")
    right: int = Field(description="Queries whose best match was right.")
    auc_pr: float = Field(description="Under the precision-recall curve; recall over right matches only.")
    auc_roc: float | None = Field(description="Queries with their place in the map against those without.")
    auc_roc_right: float = Field(description="Right answers against all others.")
    cross_validated: Held
    points: list[Point] = Field(description="The precision-recall and ROC curves, by rising threshold.")


class HeldOutAnswers(NamedTuple):
    """The answers to n queries, each by a calibration in which it had no part.

    probability: float64 [n].
    right: bool [n], whether the best match was right.
    """

    probability: Values
    right: Flags


@dataclass(frozen=True)
class FittedCalibration:
    """A calibration fitted to trials on a map, and the measurements of the fit.

    trials: the answers by the calibration.
    staged: what it was fitted to.
    held_out: the answers in the cross-validation.
    """

    calibration: Calibration
    measurement: Measurement
    trials: Trials
    staged: StagedTrials
    held_out: HeldOutAnswers


class Kinds(NamedTuple):
    """How many frames of trials show places of the map, and how many were asked in the map without their places."""

    known: int
    strangers: int

    @classmethod
    def of(cls, trials: Trials) -> Kinds:
        """Count the frames of trials."""
        return cls(*(len(np.unique(trials.frame[chosen])) for chosen in (trials.known, ~trials.known)))

    @property
    def enough(self) -> bool:
        """Whether there are enough of each to tell how probable an answer is."""
        return min(self) >= FEWEST_OF_A_KIND


def fit_map_calibration(
    trials: Trials | StagedTrials, base: Calibration, target: Target, source: str
) -> FittedCalibration:
    """Fit a calibration to the trials on one map.

    Curve and margin are fitted to answers of two stages.  Those of three then move the terms of geometric evidence, as
    far as they demand it (:func:`core.judgement.probability.movement`), and the threshold is the lowest that reaches
    the target where doubtful answers are verified.

    Args:
        trials: judged with ``base``, whose background and kind of decision value stay; of two stages alone, the terms
            of evidence stay, too.
        target: the target of the threshold.
        source: recorded in the calibration.

    Raises:
        CalibrationImpossible: there are too few trials, the decision value hardly separates right from wrong
            answers, or no threshold reaches the target; the text says which.
    """
    staged = StagedTrials.of(trials)
    _check(staged.two, target)

    def fit(chosen: Flags) -> Calibration:
        return _of_stages(staged.take(chosen), base, target, len(staged) / int(chosen.sum()))

    return _measured(staged, fit, source)


def _of_stages(trials: StagedTrials, base: Calibration, target: Target, times: float) -> Calibration:
    """Fit curve, margin, terms of evidence and threshold.

    Args:
        times: how many times as many trials there are in all, of which these are a part.
    """
    if base.geometry is None or np.isnan(trials.three.evidence).all() or target.rule == "mean_of_negatives":
        return _fitted(trials.two, base, target)
    curve, margin = _curve_and_margin(trials.two)
    margin = min(margin, _margin(trials.three.margin[trials.three.right], "lower"))  # leads in another order
    found = base.model_copy(update={"curve": curve, "margin": margin})
    found = found.model_copy(update={"geometry": _adjusted_terms(trials.three, found, curve)})
    reached = _reaching(trials, found, target, LOWEST, times=times)
    if not reached.target:
        raise _out_of_reach(target, reached.precision, len(trials))
    return reached.calibration


def adjust_calibration(
    trials: Trials | StagedTrials,
    base: Calibration,
    source: str,
    target: Target | None = None,
    present: Calibration | None = None,
) -> FittedCalibration:
    """Adjust a calibration to few trials on one map, which may be the doubtful ones.

    The curve is moved only as far as the trials demand (:func:`core.judgement.probability.movement`), and then the log
    odds of three stages by those trials that were verified.  Both tell how probable an answer is given its decision
    value and evidence; so it does not matter that frames were chosen by their answers.  The threshold goes to the
    decision value that is as probable as the old one was, or higher, and the margin stays.

    In no case more answers are recognized in the map without their place, or off the map, than before; with fewer than
    ``FEWEST_OUTCOMES`` of them the threshold falls no lower than the base's.

    With fewer than ``FEWEST_OF_A_KIND`` strangers no answer becomes likelier: known places say nothing of strangers.
    Where their answers are wrong more often than stated, the curve is shifted down.  With fewer known places nothing
    changes.

    Args:
        trials: judged with ``base``, each frame in the map as it is, and perhaps in the map without its place, too.
        source: recorded in the calibration.
        target: a precision, for which the threshold rises if it has to; None: none.  Only for trials that were not
            chosen by their answers.
        present: what is kept, in place of ``base``, where there are too few of a kind; None: the base is.

    Raises:
        CalibrationImpossible: there are too few trials, or the calibration has no curve.
    """
    staged = StagedTrials.of(trials)
    frames = len(np.unique(staged.two.frame))
    if frames < FEWEST_OUTCOMES or base.curve is None:
        raise CalibrationImpossible(
            f"A calibration is adjusted to at least {FEWEST_OUTCOMES} frames whose place is known; here are {frames}."
            if base.curve is not None
            else "The encoder's calibration has no curve that could be adjusted."
        )
    kinds = Kinds.of(staged.two)
    if present is not None and present.curve is not None and not kinds.enough:
        base = present
    return _measured(staged, lambda chosen: _adjusted(staged.take(chosen), base, target, kinds), source)


def _adjusted(trials: StagedTrials, base: Calibration, target: Target | None, kinds: Kinds) -> Calibration:
    """Adjust a calibration to a part of the trials.

    Args:
        kinds: of all of them.
    """
    assert base.curve is not None
    if kinds.known < FEWEST_OF_A_KIND:
        return base
    two = trials.two
    down, leads = not kinds.enough, share_of_leads(two.margin, base)
    curve = moved_curve(base.curve, two.decision, two.imagined, two.right, leads, down)
    moved = base.model_copy(update={"curve": curve})
    moved = moved.model_copy(update={"geometry": _adjusted_terms(trials.three, moved, curve, down)})
    strangers = ~two.known
    lowest = base.threshold if int(strangers.sum()) < FEWEST_OUTCOMES else -np.inf
    before = int(trials.answered(base).recognized(base)[strangers].sum())
    least = base.curve.probability(base.threshold)
    return _reaching(trials, moved, target, least, lowest, before).calibration


def _adjusted_terms(trials: Trials, base: Calibration, curve: Curve, down: bool = False) -> GeometryTerms | None:
    """The terms of evidence, moved as far as the trials that were verified demand.

    Args:
        curve: of two stages.
        down: as of :func:`core.judgement.probability.movement`.
    """
    verified = ~np.isnan(trials.evidence)
    if base.geometry is None or not verified.any():
        return base.geometry
    some = trials.take(verified)
    leads = share_of_lead(some.margin, some.imagined)
    odds = base.geometry.log_odds(curve.log_odds(some.decision, some.imagined), some.evidence, leads)
    stretch, shift = movement(odds, some.right, share_of_leads(some.margin, base), down)
    return GeometryTerms(
        support=stretch * base.geometry.support,
        slope=stretch * base.geometry.slope,
        lead=stretch * base.geometry.lead,
        intercept=stretch * base.geometry.intercept + shift,
    )


class _Reached(NamedTuple):
    """A threshold that was looked for.

    calibration: with the lowest one that reaches the target or, if none does, with the highest that was tried.
    target: whether it reaches the target.
    precision: the best that any of them promises.
    """

    calibration: Calibration
    target: bool
    precision: float


def _reaching(
    trials: StagedTrials,
    fitted: Calibration,
    target: Target | None,
    least: float,
    lowest: float = -np.inf,
    strangers: int | None = None,
    times: float = 1.0,
) -> _Reached:
    """The calibration with the lowest threshold that reaches a target where doubtful answers are verified.

    Args:
        fitted: with curve, margin and terms of evidence.
        target: of any rule but that of the thesis; None: none.
        least: the lowest probability that the threshold may demand.
        lowest: the lowest decision value that it may have.
        strangers: the most that may be recognized of places that the map lacks; None: any number.
        times: as of :func:`_precision`.
    """
    assert fitted.curve is not None
    best, tried, unknown = 0.0, fitted, ~trials.two.known
    for probability in np.linspace(least, max(least, HIGHEST), THRESHOLDS):
        tried = fitted.model_copy(update={"threshold": max(lowest, fitted.curve.decision(float(probability)))})
        answers = trials.answered(tried)
        believed = answers.recognized(tried)
        if not believed.any():
            break
        if strangers is not None and int(believed[unknown].sum()) > strangers:
            continue
        if target is None:
            return _Reached(tried, True, best)
        if target.rule == "false_accept_rate":
            if float(believed[unknown].mean()) <= (target.value or 0):
                return _Reached(tried, True, best)
            continue
        best = max(best, _precision(answers, believed, answers.probabilities(tried), times))
        if best >= (target.value or 0):
            return _Reached(tried, True, best)
    return _Reached(tried, False, best)


def _precision(trials: Trials, believed: Flags, expected: Values, times: float) -> float:
    """The precision that answers which are believed, bool [n], at least one, promise.

    It is the least of that which was counted, of that which the calibration expects, and of (n + 1) / (n + 2), what n
    right answers promise by the rule of succession.  Of a part of the trials, n is what all of them have by it: a block
    that is held out for measuring takes nothing from what the others promise.

    Args:
        expected: float64 [n], the probabilities that the calibration states.
        times: how many times as many trials there are in all, of which these are a part.
    """
    count = times * int(believed.sum())
    return min(float(expected[believed].mean()), float(trials.right[believed].mean()), (count + 1) / (count + 2))


def _measured(trials: StagedTrials, fit: Callable[[Flags], Calibration], source: str) -> FittedCalibration:
    """A calibration with what was measured of it.

    Args:
        fit: makes a calibration of a part of the trials, bool [n].
    """
    calibration = fit(np.ones(len(trials), np.bool_))
    two = trials.two
    frames = len(np.unique(two.frame))
    known, right = two.known, two.right
    points = curve_points(two.decision, known, right)
    held, held_out = _cross_validated(trials, fit)
    measurement = Measurement(
        frames=frames,
        trials=len(two),
        known=int(known.sum()),
        unknown=int((~known).sum()),
        right=int(right.sum()),
        auc_pr=auc_pr(two.decision, right),
        auc_roc=auc_roc(two.decision, known),
        auc_roc_right=auc_roc(two.decision, right) or 0.0,
        cross_validated=held,
        points=_thinned(points),
    )
    named = calibration.model_copy(update={"source": source, "frames": frames})
    return FittedCalibration(named, measurement, trials.answered(calibration), trials, held_out)


def blocks_of(frame: NDArray[np.int64], count: int = BLOCKS) -> list[Flags]:
    """Cut the trials into ``count`` blocks of consecutive frames, bool [n] each; fewer if there are fewer frames."""
    frames = np.unique(frame)
    runs = np.array_split(frames, min(count, len(frames)))
    return [np.isin(frame, run) for run in runs]


def cross_validated(trials: Trials, base: Calibration, target: Target) -> Held:
    """Judge each block by a calibration fitted to the other blocks.

    Raises:
        CalibrationImpossible: the blocks besides one do not suffice for a calibration.
    """
    return _cross_validated(StagedTrials.of(trials), lambda chosen: _fitted(trials.take(chosen), base, target))[0]


def _cross_validated(trials: StagedTrials, fit: Callable[[Flags], Calibration]) -> tuple[Held, HeldOutAnswers]:
    recognized, right, probabilities = (np.zeros(len(trials)) for _ in range(3))
    for block in blocks_of(trials.two.frame):
        calibration = fit(~block)
        held = trials.take(block).answered(calibration)
        recognized[block], probabilities[block] = held.recognized(calibration), held.probabilities(calibration)
        right[block] = held.right
    figures = held_figures(replace(trials.two, right=right > 0), recognized > 0, probabilities)
    return figures, HeldOutAnswers(probabilities, right > 0)


def held_figures(trials: Trials, recognized: Flags, probabilities: Values) -> Held:
    """The figures of verdicts, bool [n], and probabilities, float64 [n], of n trials."""
    passed, known = recognized & trials.right, trials.known
    return Held(
        precision=wilson(int(passed.sum()), int(recognized.sum())),
        recall=wilson(int(passed.sum()), int(known.sum())),
        false_accept_rate=wilson(int((recognized & ~known).sum()), int((~known).sum())),
        reliability=reliability(probabilities, trials.right),
    )


def curve_points(decision: Values, known: Flags, right: Flags) -> list[Point]:
    """The effect of every threshold that makes a difference, by rising threshold.

    Args:
        decision: float64 [n].
        known, right: bool [n].
    """
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
    if not Kinds.of(trials).enough:
        raise CalibrationImpossible(
            f"A calibration rests on at least {FEWEST_OF_A_KIND} frames of places of the map and as many of places "
            f"that it lacks; here are {int(trials.known.sum())} and {strangers}."
        )
    area = auc_roc(trials.decision, trials.right) or 0.0
    if area < LEAST_AREA:
        raise CalibrationImpossible(
            "On this map right answers can hardly be distinguished from wrong ones: "
            f"the area under the ROC is {area:.2f}, "
            f"at least {LEAST_AREA} is needed. Other places, or another encoder, may do."
        )


def _fitted(trials: Trials, base: Calibration, target: Target) -> Calibration:
    """Fit curve, margin and threshold."""
    curve, margin = _curve_and_margin(trials)
    return base.model_copy(update={"curve": curve, "margin": margin, "threshold": _threshold(trials, curve, target)})


def _curve_and_margin(trials: Trials) -> tuple[Curve, float]:
    try:
        curve = fit_curve(trials.decision, trials.right)
    except ValueError as error:
        raise CalibrationImpossible(f"No curve of probabilities can be fitted: {error}.") from error
    return curve, _margin(trials.margin[trials.right], "lower")


def _threshold(trials: Trials, curve: Curve, target: Target) -> float:
    """The lowest threshold that reaches the target without the margin, which makes the verdicts stricter still."""
    if target.rule == "precision":
        assert target.value is not None
        return _for_precision(trials, curve, target.value)
    strangers = np.sort(trials.decision[~trials.known])[::-1]
    if not len(strangers):
        raise CalibrationImpossible("A part of the frames has none of a place that the map lacks; mix them.")
    if target.rule == "mean_of_negatives":
        return float(strangers.mean())
    assert target.value is not None
    return _just_above(strangers[int(target.value * len(strangers))])


def _for_precision(trials: Trials, curve: Curve, wanted: float) -> float:
    """The lowest decision value above which the wanted share of answers is right, as counted and as the curve expects.

    Counts alone depend on chance in a few frames: of many thresholds, some look better than they are.
    """
    order = np.argsort(-trials.decision, kind="stable")
    passed = np.arange(1, len(trials) + 1)
    counted = np.cumsum(trials.right[order]) / passed
    expected = np.cumsum(curve.probabilities(trials.decision[order])) / passed
    last = np.append(np.diff(trials.decision[order]) != 0, True)
    reached = np.flatnonzero((counted >= wanted) & (expected >= wanted) & last)
    if not len(reached):
        raise _out_of_reach(
            Target(rule="precision", value=wanted), float(np.minimum(counted, expected)[last].max()), len(trials)
        )
    return float(trials.decision[order][reached[-1]])


def _out_of_reach(target: Target, best: float, answers: int) -> CalibrationImpossible:
    """The error where no threshold reaches a target.

    Args:
        best: the precision that the answers can promise.
    """
    if target.rule == "false_accept_rate":
        return CalibrationImpossible(
            f"No threshold accepts at most {target.value:.1%} of the unknown places. "
            "Look whether the map has some of them after all, or allow a larger share."
        )
    return CalibrationImpossible(
        f"No threshold lets {target.value:.1%} of the answers believed be right: the best that {answers} answers "
        f"can promise is {best:.1%}. Ask for less, or give more frames: they promise more, where all that is believed "
        "is right."
    )


def _thinned(points: list[Point]) -> list[Point]:
    """At most MOST_POINTS of the points, evenly spread, with the first and the last."""
    chosen = np.unique(np.linspace(0, len(points) - 1, min(MOST_POINTS, len(points))).round().astype(int))
    return [points[index] for index in chosen]
