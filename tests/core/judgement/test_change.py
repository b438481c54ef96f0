"""Whether a frame is known, changed or new: three probabilities that rise and fall as they should."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.judgement.change import NEW, SHRINKING, SUREST, UsualScore, WorldChange, change_of, log_odds_in_map
from core.judgement.probability import Curve
from core.judgement.verdict import Calibration, Judgement

CALIBRATION = Calibration(
    source="test",
    threshold=0.1,
    margin=0.01,
    background_mean=0.05,
    background_deviation=0.02,
    curve=Curve(slope=40, intercept=-4),
)
NEVER = UsualScore()
OFTEN = UsualScore(1000, 300.0)
"""A place whose recognized frames score 0.3."""


def judged(decision: float, verdict: str = "recognized") -> Judgement:
    return Judgement(verdict, 0.3, decision, None, None, 0.5)  # type: ignore[arg-type]


def change(decision: float, score: float = 0.3, usual: UsualScore = NEVER) -> WorldChange:
    found = change_of(judged(decision), CALIBRATION, score, usual)
    assert found is not None
    return found


decisions = st.floats(-1, 1)
scores = st.floats(0, 1)
usuals = st.builds(lambda count, mean: UsualScore(count, count * mean), st.integers(0, 10_000), st.floats(0, 1))


@given(decisions, scores, usuals)
def test_the_three_are_probabilities_that_sum_to_1(decision: float, score: float, usual: UsualScore) -> None:
    found = change(decision, score, usual)
    three = {"known": found.known, "changed": found.changed, "new": found.new}
    assert min(three.values()) >= 0 and sum(three.values()) == pytest.approx(1)
    assert (found.verdict == "new") == (found.new >= NEW)
    if found.verdict != "new":
        assert three[found.verdict] == max(found.known, found.changed)


@given(decisions, decisions, scores, scores, usuals)
def test_a_better_match_is_never_less_known_and_never_newer(
    one: float, other: float, score: float, further: float, usual: UsualScore
) -> None:
    worse = change(min(one, other), min(score, further), usual)
    better = change(max(one, other), max(score, further), usual)
    assert better.known >= worse.known - 1e-12
    assert better.new <= worse.new + 1e-12


def test_a_sure_match_that_scores_as_ever_is_known_and_one_that_scores_far_less_is_changed() -> None:
    assert change(0.3, 0.3, OFTEN).verdict == "known"
    assert change(0.3, 0.06, OFTEN).verdict == "changed"
    assert change(-0.2, 0.02, OFTEN).verdict == "new"


@given(st.floats(0.1001, 1), scores)
def test_a_recognized_frame_of_a_map_without_a_history_is_known(decision: float, score: float) -> None:
    assert change(decision, score).verdict == "known"


@given(decisions, st.sampled_from(["recognized", "ambiguous", "unknown"]), scores)
def test_without_a_history_an_unknown_answer_is_never_known_and_a_better_verdict_never_less_so(
    decision: float, verdict: str, score: float
) -> None:
    found = change_of(judged(decision, verdict), CALIBRATION, score)
    unknown = change_of(judged(decision, "unknown"), CALIBRATION, score)
    assert found is not None and unknown is not None
    assert unknown.verdict != "known"
    assert found.known >= unknown.known and found.new <= unknown.new


@given(decisions, scores, usuals)
def test_whether_a_place_of_the_map_looks_as_ever_is_never_certain(
    decision: float, score: float, usual: UsualScore
) -> None:
    found = change(decision, score, usual)
    assert SUREST[0] <= found.known / (1 - found.new) * (1 + 1e-9)
    assert found.known / (1 - found.new) <= SUREST[1] * (1 + 1e-9)


@given(decisions, st.floats(0, 1), st.floats(0, 1), st.floats(0, 1))
def test_a_run_weighs_three_probabilities_and_its_agreement_never_takes_from_known(
    decision: float, unknown: float, one: float, other: float
) -> None:
    alone = change(decision, 0.3, OFTEN)
    less, more = alone.during(unknown, min(one, other)), alone.during(unknown, max(one, other))
    for found in (less, more):
        assert found.new == unknown and found.known + found.changed + found.new == pytest.approx(1)
        assert found.known >= SUREST[0] * (1 - unknown) * (1 - 1e-9)
    assert more.known >= less.known


def test_a_probability_of_new_under_a_half_calls_nothing_new() -> None:
    assert WorldChange(0.32, 0.31, 0.37).verdict == "known"
    assert WorldChange(0.25, 0.26, 0.49).verdict == "changed"
    assert WorldChange(0.45, 0.05, 0.5).verdict == "new"


def test_what_is_usual_counts_the_more_the_oftener_it_was_seen() -> None:
    shares = [change(0.3, 0.06, UsualScore(count, 0.3 * count)).changed for count in (0, 1, 4, 20, 1000)]
    assert shares == sorted(shares) and shares[-1] > shares[0] + 0.2


def test_a_place_that_was_seldom_seen_takes_its_usual_score_from_the_map() -> None:
    seldom = UsualScore().within(UsualScore(1000, 200.0))
    assert seldom.count == SHRINKING and seldom.mean == pytest.approx(0.2)
    assert UsualScore(96, 96 * 0.4).within(UsualScore(1000, 200.0)).mean == pytest.approx(0.392)
    assert UsualScore().within(UsualScore()) == UsualScore() and UsualScore().mean is None


def test_a_frame_whose_rivals_explain_that_nothing_stands_out_is_as_one_that_just_does() -> None:
    alone = log_odds_in_map(judged(0.0, "unknown"), CALIBRATION)
    explained = log_odds_in_map(judged(0.0, "ambiguous"), CALIBRATION)
    assert alone == pytest.approx(-4) and explained == pytest.approx(0)


def test_without_a_match_or_a_curve_nothing_is_said() -> None:
    assert change_of(Judgement("unknown", None, None, None, None), CALIBRATION, 0.0) is None
    assert change_of(judged(0.3), CALIBRATION.model_copy(update={"curve": None}), 0.3) is None


def test_a_run_that_is_sure_of_the_place_turns_a_frame_that_fails_into_a_changed_one() -> None:
    alone = change(-0.05, 0.03)
    assert alone.verdict == "new"
    found = alone.during(unknown=0.01, agreement=1.0)
    assert found.verdict == "changed" and found.new == 0.01
    assert found.known + found.changed + found.new == pytest.approx(1)


def test_a_run_that_is_off_the_map_says_new_whatever_the_frame_says() -> None:
    assert change(0.3, 0.3, OFTEN).during(unknown=0.9, agreement=1.0).verdict == "new"


def test_a_frame_that_matches_another_place_than_the_run_knows_does_not_show_its_own_as_ever() -> None:
    sure = change(0.3, 0.3, OFTEN)
    assert sure.during(0.01, 1.0).verdict == "known" and sure.during(0.01, 0.05).verdict == "changed"
