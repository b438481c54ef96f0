"""Calibrations of encoders, from made-up scores, and of maps, from trials drawn from a known law."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import CalibrationImpossible
from core.judgement.calibration import (
    BLOCKS,
    MOST_POINTS,
    Target,
    adjust_calibration,
    blocks_of,
    cross_validated,
    curve_points,
    effect_of,
    fit_encoder_calibration,
    fit_map_calibration,
)
from core.judgement.geometry import TERMS, GeometryTerms
from core.judgement.probability import Curve
from core.judgement.reliability import reliability
from core.judgement.trials import StagedTrials, Trials, joined
from core.judgement.verdict import Calibration, Judgement, judge
from core.places import Neighborhood, Whereabouts

BASE = Calibration(
    source="encoder-default", threshold=0.09, margin=0.004, background_mean=0.07, background_deviation=0.01
)
LAW = Curve(slope=60, intercept=-6)
PRECISE = Target(rule="precision", value=0.95)


def drawn(frames: int, law: Curve = LAW, seed: int = 0) -> Trials:
    """Each frame asked with its place and without; a known one is right by the law, an unknown one never."""
    generator = np.random.default_rng(seed)
    decision = np.concatenate([generator.gamma(6, 0.025, frames), generator.gamma(3, 0.012, frames)])
    known = np.arange(2 * frames) < frames
    right = known & (generator.random(2 * frames) < law.probabilities(decision))
    frame = np.tile(np.arange(frames), 2)
    return Trials(decision, np.full(2 * frames, np.inf), known, right, frame)


def test_what_is_found_is_what_it_was_made_of() -> None:
    trials = drawn(3000)
    found = fit_map_calibration(trials, BASE, PRECISE, "sequence:tuesday")
    assert (found.calibration.source, found.calibration.frames) == ("sequence:tuesday", 3000)
    assert found.calibration.background_mean == BASE.background_mean
    passed = trials.take(trials.recognized(found.calibration))
    assert 0.945 <= passed.right.mean() <= 0.96  # no stricter than it need be
    held = found.measurement.cross_validated
    assert held.precision.value == pytest.approx(0.95, abs=0.02)
    assert held.precision.low < 0.95 < held.precision.high
    assert held.reliability.ece < 0.03
    assert (found.measurement.known, found.measurement.unknown) == (3000, 3000)


def test_a_threshold_for_a_false_accept_rate_keeps_it() -> None:
    trials = drawn(500)
    for wanted in (0.01, 0.1, 0.5):
        found = fit_map_calibration(trials, BASE, Target(rule="false_accept_rate", value=wanted), "map")
        accepted = trials.recognized(found.calibration)[~trials.known].mean()
        assert wanted - 0.005 <= accepted <= wanted


def test_the_rule_of_the_thesis_is_the_mean_of_the_negatives() -> None:
    trials = drawn(100)
    found = fit_map_calibration(trials, BASE, Target(rule="mean_of_negatives"), "map")
    assert found.calibration.threshold == pytest.approx(trials.decision[~trials.known].mean())


def test_close_rivals_are_not_let_through() -> None:
    trials = drawn(400)
    margin = np.where(trials.right, np.linspace(0.001, 0.1, len(trials)), 0.0)
    found = fit_map_calibration(
        Trials(trials.decision, margin, trials.known, trials.right, trials.frame), BASE, PRECISE, "map"
    ).calibration
    assert 0 < found.margin < 0.01
    lost = (margin[trials.right] < found.margin).mean()
    assert lost <= 0.02 + 1e-9


def test_no_frame_has_a_say_in_its_own_judgement() -> None:
    """Outcomes of one block turned round: the others' judgements hear of it, those of the block itself do not."""
    trials = drawn(200)
    block = blocks_of(trials.frame)[0]
    held = cross_validated(trials, BASE, Target(rule="mean_of_negatives"))
    assert len(blocks_of(trials.frame)) == BLOCKS
    assert set(trials.frame[block]) == set(range(40)), "both trials of a frame are in one block, frames consecutive"
    calibration = fit_map_calibration(trials.take(~block), BASE, Target(rule="mean_of_negatives"), "x").calibration
    expected = trials.take(block).recognized(calibration).sum()
    others = sum(
        trials.take(b)
        .recognized(fit_map_calibration(trials.take(~b), BASE, Target(rule="mean_of_negatives"), "x").calibration)
        .sum()
        for b in blocks_of(trials.frame)[1:]
    )
    assert held.precision.of == expected + others


@pytest.mark.parametrize("frames", [0, 1, 5, 9])
def test_too_few_frames_are_refused(frames: int) -> None:
    with pytest.raises(CalibrationImpossible, match="at least 10 right"):
        fit_map_calibration(drawn(frames), BASE, PRECISE, "map")


def test_a_map_whose_answers_show_nothing_is_refused() -> None:
    trials = drawn(300)
    noise = np.random.default_rng(1).random(len(trials))
    with pytest.raises(CalibrationImpossible, match="hardly be distinguished"):
        fit_map_calibration(
            Trials(noise, trials.margin, trials.known, trials.right, trials.frame), BASE, PRECISE, "map"
        )


def test_a_target_out_of_reach_says_what_is_within() -> None:
    generator = np.random.default_rng(3)
    decision = np.concatenate([generator.normal(0.12, 0.02, 200), generator.normal(0.10, 0.02, 200)])
    known = np.arange(400) < 200
    wrong_at_the_top = known.copy()
    wrong_at_the_top[np.argsort(-decision)[:6]] = False
    trials = Trials(decision, np.full(400, np.inf), known, wrong_at_the_top, np.tile(np.arange(200), 2))
    with pytest.raises(CalibrationImpossible, match=r"99\.9% .* best that"):
        fit_map_calibration(trials, BASE, Target(rule="precision", value=0.999), "map")


def test_a_rate_of_false_accepts_needs_unknown_places() -> None:
    trials = drawn(300)
    known = trials.take(trials.known)
    with pytest.raises(CalibrationImpossible, match="places that the map lacks"):
        fit_map_calibration(known, BASE, Target(rule="false_accept_rate", value=0.1), "map")


@pytest.mark.parametrize(("rule", "value"), [("precision", None), ("mean_of_negatives", 0.5), ("precision", 1.0)])
def test_targets_that_make_no_sense(rule: str, value: float | None) -> None:
    with pytest.raises(ValueError):
        Target.model_validate({"rule": rule, "value": value})


def tied(n: int = 400, seed: int = 5) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    generator = np.random.default_rng(seed)
    decision = np.round(generator.random(n), 2)
    return decision, generator.random(n) < decision


def test_the_points_say_what_each_threshold_does() -> None:
    decision, right = tied()
    known = right | (np.arange(400) % 3 == 0)
    points = curve_points(decision, known, right)
    assert [point.threshold for point in points] == sorted(set(decision.tolist()))
    for point in points[::10]:
        passed = decision >= point.threshold
        assert point.precision == pytest.approx(right[passed].mean())
        assert point.recall == pytest.approx(right[passed].sum() / known.sum())
        assert point.false_accept_rate == pytest.approx(passed[~known].mean())


def test_a_long_curve_has_few_points() -> None:
    points = fit_map_calibration(drawn(1000), BASE, PRECISE, "map").measurement.points
    assert len(points) == MOST_POINTS
    assert points[0].false_accept_rate == 1.0


def test_trials_of_other_frames_are_numbered_on() -> None:
    one, other = drawn(20), drawn(30)
    assert len(np.unique(joined([one, other]).frame)) == 50
    assert len(np.unique(joined([one, one], same_frames=True).frame)) == 20


N = 60


def made_up(seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Unrelated frames score about 0.1 ± 0.02; neighbours 0.5, the frame itself 1; second looks a little less."""
    random = np.random.default_rng(seed)
    unknown = random.normal(0.1, 0.02, (N, N)).astype(np.float32)
    unknown = (unknown + unknown.T) / np.sqrt(2)
    unknown += np.float32(0.1 - unknown.mean())
    known = unknown.copy()
    near = np.abs(np.subtract.outer(np.arange(N), np.arange(N))) <= 2
    unknown[near], known[near] = 0.5, 0.4
    np.fill_diagonal(unknown, 1.0)
    np.fill_diagonal(known, 0.6)
    return unknown, known


def test_the_background_is_that_of_frames_that_are_apart() -> None:
    unknown, known = made_up()
    apart = np.abs(np.subtract.outer(np.arange(N), np.arange(N))) > 2
    made = fit_encoder_calibration(unknown, known, 2, "encoder-default")
    assert made.background_mean == pytest.approx(float(unknown[apart].mean()))
    assert made.background_deviation == pytest.approx(float(unknown[apart].std()))
    assert made.source == "encoder-default"


def judged(scores: NDArray[np.float32], places: NDArray[np.intp], calibration: Calibration) -> Judgement:
    """The judgement of one query against a map of the frames ``places``."""
    order = places[np.argsort(-scores[places], kind="stable")]
    n = len(order)
    frames = Whereabouts(np.zeros(n, np.int8), np.zeros((n, 3)), np.zeros(n, np.int32), order)
    return judge(scores[order], frames, calibration, Neighborhood(radius=0.0, frames=2))


def test_few_strangers_are_recognized_and_all_second_looks() -> None:
    unknown, known = made_up()
    made = fit_encoder_calibration(unknown, known, 2, "encoder-default")
    everywhere = np.arange(N)
    strangers = [judged(unknown[i], everywhere[np.abs(everywhere - i) > 2], made).verdict for i in range(N)]
    unknowns = strangers.count("unknown")
    assert 0.85 * N <= unknowns < N  # the threshold is not higher than it need be
    # The margin is the smallest lead but for 2 %: of 60 looks the one or two closest become ambiguous.
    looks = [judged(known[i], everywhere, made).verdict for i in range(N)]
    assert looks.count("recognized") >= 0.95 * N
    assert "unknown" not in looks
    assert 0.35 < made.margin < 0.5


def test_frames_that_are_all_alike() -> None:
    alike = np.ones((12, 12), np.float32)
    made = fit_encoder_calibration(alike, alike, 2, "encoder-default")
    assert made.background_deviation > 0
    assert np.isfinite(made.threshold)
    assert made.margin == 0.0


def test_too_few_frames() -> None:
    with pytest.raises(ValueError, match="too few"):
        fit_encoder_calibration(np.ones((3, 3), np.float32), np.ones((3, 3), np.float32), 2, "encoder-default")


def test_the_curve_is_sure_of_second_looks_and_not_of_strangers() -> None:
    unknown, known = made_up()
    made = fit_encoder_calibration(unknown, known, 2, "encoder-default")
    assert made.curve is not None
    assert (made.decision, made.frames) == ("leading", N)
    looks = [judged(known[i], np.arange(N), made).probability for i in range(N)]
    strangers = [judged(unknown[i], np.flatnonzero(np.abs(np.arange(N) - i) > 2), made).probability for i in range(N)]
    assert np.median(np.array(looks, float)) > 0.9
    assert np.median(np.array(strangers, float)) < 0.1


def test_the_effect_of_a_calibration_is_what_its_verdicts_do() -> None:
    trials = drawn(300)
    trials.margin[::7] = 0.001  # a rival is close
    for threshold in (-1.0, 0.05, 0.12, 9.0):
        calibration = BASE.model_copy(update={"threshold": threshold, "margin": 0.002, "curve": LAW})
        effect = effect_of(trials, calibration)
        believed, apart = trials.decision >= threshold, trials.margin >= 0.002
        recognized = believed & apart
        assert effect.verdicts.recognized == recognized.sum() == effect.precision.of
        assert effect.verdicts.ambiguous == (believed & ~apart).sum()
        assert effect.verdicts.unknown == (~believed).sum()
        assert effect.recall.count == (recognized & trials.right).sum() and effect.recall.of == 300
        assert effect.false_accept_rate.count == (recognized & ~trials.known).sum()
        assert effect.reliability is not None
        assert effect.reliability.brier == pytest.approx(
            np.square(trials.probabilities(calibration) - trials.right).mean()
        )
    assert effect_of(trials, BASE).reliability is None, "without a curve there are no probabilities"


def test_trials_are_the_same_as_json() -> None:
    trials = drawn(20)
    trials.evidence[3] = 7.5
    again = Trials.of_record(json.loads(json.dumps(trials.record(), allow_nan=False)))
    for name in ("decision", "margin", "known", "right", "frame", "imagined", "evidence"):
        before, after = getattr(trials, name), getattr(again, name)
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(before, after)
    for wrong in ({}, trials.record() | {"right": [True]}, trials.record() | {"frame": ["x"]}):
        with pytest.raises((KeyError, TypeError, ValueError)):
            Trials.of_record(wrong)  # type: ignore[arg-type]


def test_trials_of_stages_are_the_same_as_json() -> None:
    two = drawn(20)
    staged = StagedTrials(two, replace(two, evidence=np.full(40, 8.0)))
    again = StagedTrials.of_record(json.loads(json.dumps(staged.record(), allow_nan=False)))
    assert again.record() == staged.record()
    plain = StagedTrials.of_record(two.record())
    assert plain.two.record() == plain.three.record() == two.record(), "what was stored before there were stages"
    for wrong in ({}, {"two": two.record()}, {"two": two.record(), "three": drawn(19).record()}):
        with pytest.raises((KeyError, TypeError, ValueError)):
            StagedTrials.of_record(wrong)


def test_doubtful_labels_make_the_probabilities_of_all_answers_better() -> None:
    base = BASE.model_copy(update={"curve": Curve(slope=60, intercept=-3)})  # too sure, for this environment
    asked, held_out = drawn(60), drawn(500, seed=1)
    doubtful = asked.take(~asked.recognized(base))
    found = adjust_calibration(doubtful, base, "labels")
    errors = [float(np.mean((held_out.probabilities(one) - held_out.right) ** 2)) for one in (base, found.calibration)]
    assert errors[1] < 0.8 * errors[0]
    after = found.calibration
    assert after.curve is not None and base.curve is not None
    assert after.curve.probability(after.threshold) == pytest.approx(base.curve.probability(base.threshold))
    assert (after.margin, after.source, after.frames) == (base.margin, "labels", len(np.unique(doubtful.frame)))
    assert found.measurement.trials == len(doubtful)


@pytest.mark.thorough
def test_for_a_precision_the_threshold_rises() -> None:
    base = BASE.model_copy(update={"curve": Curve(slope=60, intercept=-2), "threshold": 0.05})  # believes too much
    asked, held_out = drawn(400), drawn(2000, seed=1)
    plain, precise = (adjust_calibration(asked, base, "runs", one).calibration for one in (None, PRECISE))
    assert precise.threshold > plain.threshold and precise.curve == plain.curve
    right = held_out.right[held_out.recognized(precise)].mean()
    assert right >= 0.93 and right > held_out.right[held_out.recognized(plain)].mean()
    hopeless = asked.take(~asked.right)
    assert not hopeless.recognized(adjust_calibration(hopeless, base, "runs", PRECISE).calibration).any()


@pytest.mark.parametrize("target", [None, PRECISE])
def test_without_strangers_the_threshold_does_not_fall(target: Target | None) -> None:
    """Right answers alone make every answer likelier; strangers are recognized no more often for it."""
    base = BASE.model_copy(update={"curve": LAW, "threshold": 0.1})
    surely = drawn(200, Curve(slope=60, intercept=0))
    strangers = np.cumsum(~surely.known)
    nine, ten = (surely.take(surely.right | ((~surely.known) & (strangers <= most))) for most in (9, 10))
    found = adjust_calibration(nine, base, "labels", target).calibration
    assert found.threshold == base.threshold
    assert found.curve is not None and found.curve.probability(0.1) > LAW.probability(0.1), "they are likelier"
    assert adjust_calibration(ten, base, "labels", target).calibration.threshold < base.threshold


def labels(known: int, strangers: int, right: int) -> Trials:
    """Doubtful frames: of places of the map, of which so many are answered rightly, and strangers."""
    count = known + strangers
    shows = np.arange(count) < known
    return Trials(
        np.linspace(0.04, 0.1, count), np.full(count, np.inf), shows, np.arange(count) < right, np.arange(count)
    )


TIMID = BASE.model_copy(update={"curve": Curve(slope=60, intercept=-8), "geometry": TERMS})
"""It states less than is true of places that the map has."""


@pytest.mark.parametrize(
    ("asked", "rises", "falls"),
    [
        (labels(10, 0, right=10), False, False),
        (labels(10, 2, right=10), False, False),
        (labels(200, 0, right=200), False, False),
        (labels(10, 0, right=0), False, True),
        (labels(0, 10, right=0), False, False),
        (labels(2, 30, right=2), False, False),
        (labels(10, 3, right=10), True, False),
    ],
)
@pytest.mark.parametrize("evidence", [np.nan, 12.0])
@pytest.mark.parametrize("target", [None, PRECISE])
def test_labels_of_one_kind_make_no_answer_likelier(
    asked: Trials, rises: bool, falls: bool, evidence: float, target: Target | None
) -> None:
    """Ten right answers to known places tell nothing of strangers, and ten strangers nothing of known places."""
    asked = replace(asked, evidence=np.full(len(asked), evidence))
    found = adjust_calibration(asked, TIMID, "labels", target).calibration
    scores = np.linspace(-0.2, 0.4, 61)
    for verified in (np.nan, 0.0, 12.0, 60.0):
        any_answer = Trials(
            scores, np.full(61, np.inf), scores > 9, scores > 9, np.arange(61), evidence=np.full(61, verified)
        )
        before, after = (any_answer.probabilities(one) for one in (TIMID, found))
        assert bool((after > before + 1e-9).any()) == rises
        if falls or not rises:
            assert bool((after < before - 1e-6).any()) == falls
    if not rises:
        assert found.threshold >= TIMID.threshold - 1e-9


def test_labels_of_one_kind_keep_the_calibration_in_force() -> None:
    present = TIMID.model_copy(update={"curve": LAW, "threshold": 0.13, "source": "sequence:tuesday"})
    kept = adjust_calibration(labels(10, 0, right=10), TIMID, "labels", present=present).calibration
    assert (kept.curve, kept.source) == (LAW, "labels") and kept.threshold == pytest.approx(0.13)
    both = adjust_calibration(labels(10, 10, right=10), TIMID, "labels", present=present).calibration
    assert both == adjust_calibration(labels(10, 10, right=10), TIMID, "labels").calibration, "labels move the base"


def test_known_places_alone_are_no_calibration() -> None:
    """Right and wrong answers to places of the map, and no stranger: nothing is fitted to them."""
    known = drawn(300).take(drawn(300).known)
    assert 10 < known.right.sum() < len(known) - 10
    with pytest.raises(CalibrationImpossible, match="here are 300 and 0"):
        fit_map_calibration(known, BASE, PRECISE, "frames")


@pytest.mark.thorough
def test_three_stages_recognize_more_at_the_same_precision() -> None:
    """Evidence tells right from wrong where decision values do not; it is asked only where two stages leave doubt."""

    def staged(frames: int, seed: int) -> StagedTrials:
        two = drawn(frames, Curve(slope=20, intercept=-3), seed)
        generator = np.random.default_rng(seed + 100)
        evidence = np.where(two.right, generator.gamma(4, 20, len(two)), generator.gamma(1, 4, len(two)))
        return StagedTrials(two, replace(two, evidence=evidence))

    base = BASE.model_copy(update={"geometry": TERMS})
    trials, held_out = staged(300, 0), staged(1500, 1)
    shares = {}
    for name, given in (("two", trials.two), ("three", trials)):
        found = fit_map_calibration(given, base, PRECISE, "sequence:tuesday")
        answers = held_out.two if name == "two" else held_out.answered(found.calibration)
        believed = answers.recognized(found.calibration)
        assert answers.right[believed].mean() > 0.9
        assert found.measurement.cross_validated.precision.low < 0.95
        shares[name] = (believed & answers.right).sum() / held_out.two.known.sum()
        if name == "three":
            asked = ~np.isnan(answers.evidence)
            assert 0 < asked.sum() < len(answers), "an answer without doubt is not verified"
            assert found.calibration.geometry is not None and found.calibration.geometry != TERMS
    assert shares["three"] > 1.2 * shares["two"]
    for rule in (Target(rule="false_accept_rate", value=0.05), Target(rule="mean_of_negatives")):
        assert fit_map_calibration(trials, base, rule, "x").measurement.trials == 600
    with pytest.raises(CalibrationImpossible, match=r"No threshold lets 99\.9% of the answers"):
        fit_map_calibration(trials, base, Target(rule="precision", value=0.999), "x")


@pytest.mark.thorough
def test_blocks_held_out_take_nothing_from_the_promise() -> None:
    """Twenty frames, all of them right where the map has their places, promise 95 % by the rule of succession."""

    def walked(frames: int) -> StagedTrials:
        known = np.arange(2 * frames) < frames
        evidence = np.where(known, 300.0, 0.0)
        decision = np.where(known, 0.4, 0.0) + 0.001 * np.tile(np.arange(frames), 2)
        lead = np.full(2 * frames, np.inf)
        two = Trials(decision, lead, known, known, np.tile(np.arange(frames), 2))
        return StagedTrials(two, replace(two, evidence=evidence))

    base = BASE.model_copy(update={"geometry": TERMS})
    found = fit_map_calibration(walked(20), base, PRECISE, "frames")
    assert found.measurement.cross_validated.recall.count == 20
    with pytest.raises(CalibrationImpossible, match=r"best that 34 answers can promise is 94\.7%\. Ask for less"):
        fit_map_calibration(walked(17), base, PRECISE, "frames")


def test_outcomes_of_verified_answers_move_the_terms_of_evidence() -> None:
    """What evidence is worth on this map: here the terms of the base deny answers that are right."""
    curve = Curve(slope=40, intercept=-5)
    doubting = GeometryTerms(support=0.5, slope=1.0, intercept=-6.0)
    base = BASE.model_copy(update={"curve": curve, "geometry": doubting})
    asked, held_out = (replace(one, evidence=np.full(len(one), 5.0)) for one in (drawn(80), drawn(500, seed=1)))
    found = adjust_calibration(asked, base, "runs").calibration
    assert found.geometry is not None and found.geometry != doubting
    errors = [reliability(held_out.probabilities(one), held_out.right).ece for one in (base, found)]
    assert errors[1] < errors[0] / 2
    unverified = adjust_calibration(drawn(80), base, "runs").calibration
    assert unverified.geometry == doubting, "without evidence nothing is known of it"


def test_a_calibration_is_not_adjusted_to_next_to_nothing() -> None:
    few = drawn(60).take(np.arange(120) < 9)
    with pytest.raises(CalibrationImpossible, match="at least 10 frames whose place is known; here are 9"):
        adjust_calibration(few, BASE.model_copy(update={"curve": LAW}), "labels")
    with pytest.raises(CalibrationImpossible, match="no curve"):
        adjust_calibration(drawn(60), BASE, "labels")
    wrong = drawn(60).take(~drawn(60).right)
    assert adjust_calibration(wrong, BASE.model_copy(update={"curve": LAW}), "labels").measurement.right == 0
