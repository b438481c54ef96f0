"""What geometric verification adds to a judgement: order, probability, verdicts, rivals, and where to look at all."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from core.judgement.background import Environment
from core.judgement.calibration import Target, fit_encoder_calibration, fit_map_calibration
from core.judgement.geometry import (
    AGREEMENT,
    INLIERS,
    LEAD,
    MOST_TAKEN,
    SIMILARITY,
    TERMS,
    Geometry,
    GeometryTerms,
    final_gains,
    final_order,
)
from core.judgement.probability import Curve, sigmoid
from core.judgement.trials import Trials
from core.judgement.verdict import Calibration, Judgement, Likeness, Rivals, judge, worth_verifying
from core.places import NO_POSE, NO_SEQUENCE, Neighborhood, Whereabouts

WITHOUT = Calibration(
    source="test",
    threshold=0.09,
    margin=0.004,
    background_mean=0.07,
    background_deviation=0.014,
    curve=Curve(slope=37, intercept=-3.5, imagined_slope=-28, imagined_intercept=3),
    environment=Environment(mean=0.13, deviation=0.034, mean_weight=0.66, deviation_weight=6.6),
)
CALIBRATION = WITHOUT.model_copy(update={"geometry": TERMS})
NEARBY = Neighborhood(radius=5.0, frames=3)
NOT = float("nan")
STREET = np.linspace(0.12, 0.05, 118, dtype=np.float32)
"""The scores of other places of a full map."""


def alone(n: int) -> Whereabouts:
    """Places with neither a pose nor a sequence."""
    return Whereabouts(np.full(n, NO_POSE, np.int8), np.zeros((n, 3)), np.full(n, NO_SEQUENCE, np.int32), np.arange(n))


def found(count: int, *evidence: float) -> Geometry:
    """Evidence of the first candidates, with shares of inliers that go with it."""
    whole = np.full(count, np.nan)
    whole[: len(evidence)] = evidence
    return Geometry(whole, np.nan_to_num(whole) / 1000)


def judged(scores: NDArray[np.float32], *evidence: float, calibration: Calibration = CALIBRATION) -> Judgement:
    count = len(scores)
    geometry = found(count, *evidence) if evidence else None
    return judge(scores, alone(count), calibration, NEARBY, geometry=geometry)


def full(*best: float) -> NDArray[np.float32]:
    return np.concatenate([np.array(best, np.float32), STREET])


def test_candidates_are_ordered_by_score_and_share_of_inliers() -> None:
    scores, share = np.array([0.3, 0.29, 0.28, 0.27], np.float32), np.array([0.0, 0.1, 0.0, 0.02])
    gains = final_gains(share)
    assert gains == pytest.approx(INLIERS * share)
    assert final_order(scores, gains).tolist() == [1, 0, 3, 2]
    assert final_order(np.full(3, 0.2, np.float32), np.zeros(3)).tolist() == [0, 1, 2], "ties keep their order"


def test_cells_lose_a_part_of_their_say_to_the_first_stage() -> None:
    similarity, agreement = np.array([0.2, 0.25], np.float32), np.array([0.12, 0.05], np.float32)
    gains = final_gains(np.array([0.1, 0.1]), similarity, agreement)
    assert gains == pytest.approx(INLIERS * 0.1 + SIMILARITY * similarity - AGREEMENT * agreement)
    assert final_order(similarity + agreement, gains).tolist() == [1, 0]


def test_evidence_and_gain_are_of_the_same_candidates() -> None:
    with pytest.raises(ValueError, match="same candidates"):
        Geometry(np.array([1.0, 2.0]), np.array([0.1]))


@pytest.mark.parametrize("scores", [full(0.3), full(0.13), full(0.3, 0.299), np.array([0.2], np.float32)])
def test_without_verification_nothing_changes(scores: NDArray[np.float32]) -> None:
    plain = judged(scores, calibration=WITHOUT)
    assert judged(scores) == plain, "terms alone mean nothing"
    assert judged(scores, NOT) == plain, "nor do candidates of which none was verified"
    assert plain.evidence is None


def test_calibrations_without_terms_do_not_weigh_evidence() -> None:
    plain, verified = judged(full(0.3), calibration=WITHOUT), judged(full(0.3), 0.0, calibration=WITHOUT)
    assert (verified.verdict, verified.probability, verified.evidence) == (plain.verdict, plain.probability, 0.0)


def test_a_map_of_one_place_believes_evidence() -> None:
    """What score a stranger has there, nobody can know; evidence needs no other place."""
    one = np.array([0.2], np.float32)
    plain, fits, fails = judged(one), judged(one, 150.0), judged(one, 5.0)
    assert (plain.verdict, fits.verdict, fails.verdict) == ("unknown", "recognized", "unknown")
    assert plain.probability is not None and fits.probability is not None and fails.probability is not None
    assert fails.probability < 0.1 < plain.probability < 0.6 < 0.7 < fits.probability
    assert fits.evidence == 150.0


def test_the_probability_rises_with_evidence_and_with_the_decision_value() -> None:
    by_evidence = [judged(full(0.2), evidence).probability for evidence in (0.0, 20.0, 80.0, 400.0)]
    by_score = [judged(full(score), 50.0).probability for score in (0.13, 0.16, 0.2, 0.3)]
    for probabilities in (by_evidence, by_score):
        values = [value for value in probabilities if value is not None]
        assert len(values) == 4 and (np.diff(values) > 0).all()


def test_two_places_of_one_picture_stay_ambiguous_however_much_evidence_both_have() -> None:
    twins = judged(np.array([0.6, 0.6], np.float32), 900.0, 900.0)
    assert (twins.verdict, twins.margin) == ("ambiguous", 0.0)
    assert twins.probability is not None and twins.probability <= 0.5
    assert twins.rivals == (Rivals((1,), False),)


def test_a_best_match_that_fits_needs_no_lead_in_score_over_rivals_that_do_not() -> None:
    scores = full(0.3, 0.299)
    assert judged(scores).verdict == "ambiguous"
    verified = judged(scores, 300.0, 0.0)
    assert verified.verdict == "recognized" and verified.rivals == ()
    assert verified.margin == pytest.approx(0.6 - 0.299, abs=1e-6), "by three stages"


def led(lead: float, evidence: float, calibration: Calibration = CALIBRATION) -> Judgement:
    """Two places of nearly one score in a full map; the first is ahead in the final order by some lead."""
    scores = full(0.157, 0.156)
    gain = np.zeros(len(scores))
    gain[0] = lead - 0.001
    both = np.where(np.arange(len(scores)) < 2, evidence, NOT)
    return judge(scores, alone(len(scores)), calibration, NEARBY, geometry=Geometry(both, gain))


@pytest.mark.parametrize("evidence", [5.0, 20.0, 80.0])
def test_a_place_that_fits_better_than_all_others_is_believed_sooner(evidence: float) -> None:
    """Places of one scene share keypoints: the same evidence means less if a rival has nearly as much."""
    stated = [led(lead, evidence).probability or 0.0 for lead in (0.01, 0.02, 0.04, LEAD, 2 * LEAD)]
    assert (np.diff(stated[:4]) > 0).all() and stated[4] == pytest.approx(stated[3])
    odds = [np.log(one / (1 - one)) for one in stated]
    assert odds[3] - odds[0] == pytest.approx(TERMS.lead * (1 - 0.01 / LEAD))


def test_the_verdict_follows_the_probability_that_a_lead_leaves() -> None:
    found = [led(lead, evidence) for lead in (0.005, 0.02, LEAD) for evidence in (2.0, 10.0, 20.0, 40.0, 200.0)]
    assert {one.verdict for one in found} == {"recognized", "unknown"}
    for one in found:
        assert (one.verdict == "recognized") == ((one.probability or 0.0) >= 0.5)


def test_where_other_places_are_imagined_there_is_none_to_lead() -> None:
    """A map of one place believes its evidence as if a lead said nothing."""
    one = np.array([0.2], np.float32)
    without = CALIBRATION.model_copy(update={"geometry": TERMS.model_copy(update={"lead": 0.0})})
    for evidence in (5.0, 50.0, 300.0):
        assert judged(one, evidence).imagined == 1.0
        assert judged(one, evidence).probability == judged(one, evidence, calibration=without).probability
    unprepared = CALIBRATION.model_copy(update={"environment": None})  # imagines nothing
    plain = unprepared.model_copy(update={"geometry": without.geometry})
    found = judged(one, 3.0, calibration=unprepared)
    assert (found.imagined, found.margin) == (0.0, None)
    assert found.probability == judged(one, 3.0, calibration=plain).probability


def test_a_rival_that_shows_the_same_place_explains_that_nothing_leads() -> None:
    """Neighbours in a map that does not know that they are neighbours: the answer names them, and is not unknown."""
    scores = full(0.157, 0.156)
    geometry = found(len(scores), 20.0, 19.0)

    def ask(likeness: Likeness | None) -> Judgement:
        return judge(scores, alone(len(scores)), CALIBRATION, NEARBY, likeness=likeness, geometry=geometry)

    assert ask(None).verdict == "unknown"
    same = ask(lambda at: np.where(at == 1, 0.9, 0.1).astype(np.float32))
    assert (same.verdict, same.rivals) == ("ambiguous", (Rivals((1,), True),))


def test_another_order_leaves_the_background_the_same() -> None:
    """A place with a lower score may be first after verification; the others are compared by their scores."""
    scores = full(0.2, 0.21, 0.15)
    judgement = judged(scores, 300.0, 0.0, 10.0)
    assert judgement.decision is not None and judgement.score == pytest.approx(0.2)
    top = np.sort(scores[1:])[::-1][:5].mean()
    assert judgement.decision == pytest.approx(-np.sqrt(top * (top - 0.2)) if top > 0.2 else np.sqrt(0.2 * (0.2 - top)))


@pytest.mark.parametrize(
    ("scores", "evidence", "worth"),
    [
        (full(0.5), (), False),  # certain
        (full(0.11), (), False),  # hopeless
        (full(0.121), (), True),
        (full(0.157), (), True),  # in doubt
        (full(0.3, 0.299), (), True),  # two that look alike
        (np.array([0.2], np.float32), (), True),  # a small map
        (np.array([0.6], np.float32), (), True),
        (np.array([], np.float32), (), False),
        (full(0.157), (300.0,), False),  # verified for the pose
        (full(0.157), (0.0,), True),  # two stages were in doubt, and no evidence does not settle it
        (full(0.11), (0.0,), False),
        (full(0.157), (8.0,), True),
    ],
)
def test_auto_looks_where_doubt_is_left(scores: NDArray[np.float32], evidence: tuple[float, ...], worth: bool) -> None:
    assert worth_verifying(judged(scores, *evidence), CALIBRATION) is worth
    assert not worth_verifying(judged(scores, *evidence, calibration=WITHOUT), WITHOUT), "evidence could not be weighed"


def test_trials_are_judged_as_their_queries_were() -> None:
    """By the probability of three stages where the best match was verified, else by the decision value."""
    cases = [(full(0.3), ()), (full(0.13), ()), (full(0.13), (300.0,)), (full(0.3), (0.0,)), (full(0.3, 0.299), ())]
    judgements = [judged(scores, *evidence) for scores, evidence in cases]
    flags = np.ones(len(cases), np.bool_)
    trials = Trials(
        np.array([one.decision for one in judgements]),
        np.array([one.margin for one in judgements]),
        flags,
        flags,
        np.arange(len(cases)),
        np.array([one.imagined for one in judgements]),
        np.array([NOT if one.evidence is None else one.evidence for one in judgements]),
    )
    assert trials.recognized(CALIBRATION).tolist() == [one.verdict == "recognized" for one in judgements]
    assert trials.probabilities(CALIBRATION) == pytest.approx([one.probability for one in judgements])


def test_a_strict_threshold_leaves_more_in_doubt() -> None:
    """An answer that is too weak for a calibration's threshold may still be settled by evidence."""
    assert CALIBRATION.curve is not None
    likely = Judgement("recognized", 0.3, CALIBRATION.curve.decision(0.7), None, None, 0.7)
    assert not worth_verifying(likely, CALIBRATION)
    strict = CALIBRATION.model_copy(update={"threshold": CALIBRATION.curve.decision(0.9)})
    assert worth_verifying(likely, strict)


def test_calibrations_that_are_fitted_keep_the_terms() -> None:
    random = np.random.default_rng(0)
    known = np.arange(200) % 2 == 0
    decision = np.where(known, random.normal(0.2, 0.03, 200), random.normal(0.08, 0.03, 200))
    trials = Trials(decision, np.full(200, 0.05), known, known, np.arange(200) // 2)
    own = fit_map_calibration(trials, CALIBRATION, Target(rule="precision", value=0.95), "map").calibration
    assert own.geometry == TERMS
    scores = random.normal(0.1, 0.02, (60, 60)).astype(np.float32)
    looks = scores + 0.3 * np.eye(60, dtype=np.float32)
    assert fit_encoder_calibration(scores, looks, 3, "encoder").geometry == TERMS


def test_old_calibrations_are_written_as_they_were_read() -> None:
    assert "geometry" not in WITHOUT.model_dump(mode="json")
    assert Calibration.model_validate(CALIBRATION.model_dump(mode="json")) == CALIBRATION
    before_leads = {"support": 0.5, "slope": 1.463, "intercept": -4.954}
    assert GeometryTerms.model_validate(before_leads).model_dump(mode="json") == before_leads


def test_no_evidence_takes_away_no_more_than_right_matches_without_any_allow() -> None:
    """A best match of two stages with 0.84 had 0.08 after verification found nothing."""
    likely = np.log(0.84 / 0.16)
    assert sigmoid(TERMS.log_odds(likely, 0.0, 1.0)) > 0.4
    before = np.linspace(-6, 6, 25)
    for evidence in (0.0, 3.0, 20.0, 300.0):
        after = TERMS.log_odds(before, evidence, 0.0)
        assert (after >= before - MOST_TAKEN - 1e-12).all()
        assert (np.diff(after) > 0).all()
