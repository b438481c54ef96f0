"""Verdicts: what stands out, who is a rival, and maps too small to say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from core.judgement.probability import Curve
from core.judgement.verdict import Calibration, Environment, Likeness, Rivals, judge, probability_of
from core.places import GEOGRAPHIC, METRIC, NO_POSE, NO_SEQUENCE, Neighborhood, Pose, Whereabouts

CALIBRATION = Calibration(
    source="encoder-default", threshold=0.2, margin=0.01, background_mean=0.02, background_deviation=0.01
)
NEARBY = Neighborhood(radius=5.0, frames=3)


def in_sequence(n: int, ordinals: list[int] | None = None) -> Whereabouts:
    order = np.array(ordinals if ordinals is not None else range(n), np.int64)
    return Whereabouts(np.zeros(n, np.int8), np.zeros((n, 3)), np.zeros(n, np.int32), order)


def at(positions: list[tuple[float, float]]) -> Whereabouts:
    n = len(positions)
    xyz = np.array([(x, y, 0) for x, y in positions], np.float64)
    return Whereabouts(np.full(n, METRIC, np.int8), xyz, np.arange(n, dtype=np.int32), np.zeros(n, np.int64))


def falling(*scores: float) -> NDArray[np.float32]:
    return np.array(scores, np.float32)


def test_an_empty_map_is_unknown_without_a_score() -> None:
    judgement = judge(falling(), in_sequence(0), CALIBRATION, NEARBY)
    assert judgement.verdict == "unknown"
    assert judgement.score is judgement.margin is judgement.decision is judgement.rival is None


def test_one_place_recognizes_itself_and_has_no_rival() -> None:
    judgement = judge(falling(0.9), in_sequence(1), CALIBRATION, NEARBY)
    assert (judgement.verdict, judgement.margin, judgement.rival) == ("recognized", None, None)


def test_one_place_does_not_recognize_an_unrelated_frame() -> None:
    assert judge(falling(0.02), in_sequence(1), CALIBRATION, NEARBY).verdict == "unknown"


def test_neighbouring_frames_are_no_rivals() -> None:
    scores = falling(0.5, 0.49, 0.48, 0.2, 0.1)
    judgement = judge(scores, in_sequence(5, [10, 11, 8, 14, 30]), CALIBRATION, NEARBY)
    assert judgement.rival == 3
    assert judgement.margin == pytest.approx(0.3, abs=1e-6)
    assert judgement.verdict == "recognized"


def test_a_close_rival_elsewhere_makes_it_ambiguous() -> None:
    rest = [0.03 - 0.0001 * i for i in range(60)]
    judgement = judge(falling(0.5, 0.495, *rest), in_sequence(62), CALIBRATION, Neighborhood(5, 0))
    assert judgement.verdict == "ambiguous"
    assert judgement.rival == 1


STOREYS = Whereabouts(
    np.full(62, METRIC, np.int8),
    np.array([(0, 0, 0), (0, 0, 4), *((100.0 + 20 * i, 0, 0) for i in range(60))]),
    np.arange(62, dtype=np.int32),
    np.zeros(62, np.int64),
    height=np.array([0.0, 4.0] + [0.0] * 60),
)
"""Two places one above the other, and others."""
PRIOR = np.log(np.where(STOREYS.height, 0.1, 1.0))


@pytest.mark.parametrize(
    ("lead", "alike", "verdict"),
    [
        (0.005, 0.2, "ambiguous"),
        (0.1, 0.8, "ambiguous"),
        (0.2, 0.8, "ambiguous"),  # the storeys are more alike than the query is like either
        (0.1, 0.4, "ambiguous"),  # less than half of 0.5 · (1 - 0.4)
        (0.2, 0.4, "recognized"),
        (0.47, 0.8, "recognized"),  # the frame does not show the other one at all
        (0.1, None, "recognized"),
    ],
)
def test_a_storey_is_told_by_what_the_query_shows_alone(lead: float, alike: float | None, verdict: str) -> None:
    curve = CALIBRATION.model_copy(update={"curve": Curve(slope=40.0, intercept=-8.0)})
    rest = [0.03 - 0.0001 * i for i in range(60)]
    scores = falling(0.5, 0.5 - lead, *rest)

    def likeness(positions: NDArray[np.int64]) -> NDArray[np.float32]:
        return np.where(positions == 1, alike or 0.0, 0.0).astype(np.float32)

    judgement = judge(scores, STOREYS, curve, NEARBY, likeness=None if alike is None else likeness)
    assert judgement.verdict == verdict and judgement.probability is not None
    assert (judgement.probability <= 0.5) == (verdict == "ambiguous")
    assert judgement.twins == ((1,) if verdict == "ambiguous" else ())
    stated = judge(scores, STOREYS, curve, NEARBY, likeness=likeness, prior=PRIOR, alone=scores)
    assert stated.verdict == ("recognized" if lead > 0.01 else "ambiguous")
    together = replace(STOREYS, level=np.zeros(62, np.int32))
    assert judge(scores, together, curve, NEARBY, likeness=likeness).verdict == "recognized", "one storey, by its level"


def test_poses_decide_before_sequences_do() -> None:
    # Other sequences (codes differ), but 3 m and 8 m away.
    judgement = judge(falling(0.5, 0.49, 0.3), at([(0, 0), (3, 0), (8, 0)]), CALIBRATION, NEARBY)
    assert judgement.rival == 2


def test_a_pose_beside_no_pose_is_compared_by_sequence() -> None:
    places = Whereabouts(
        np.array([METRIC, NO_POSE, NO_POSE], np.int8),
        np.zeros((3, 3)),
        np.array([0, 0, 1], np.int32),
        np.array([5, 6, 6], np.int64),
    )
    assert places.near(0, NEARBY).tolist() == [True, True, False]


def test_degrees_are_compared_in_metres() -> None:
    here, there = Pose(latitude=48.8462, longitude=2.3464), Pose(latitude=48.8462, longitude=2.34654)  # 10.2 m apart
    places = Whereabouts(
        np.full(2, GEOGRAPHIC, np.int8),
        np.stack([here.position(), there.position()]),
        np.array([0, 1], np.int32),
        np.zeros(2, np.int64),
    )
    assert places.near(0, Neighborhood(10.0, 0)).tolist() == [True, False]
    assert places.near(0, Neighborhood(10.5, 0)).tolist() == [True, True]


def test_equal_scores_everywhere_are_unknown_not_a_division_by_zero() -> None:
    judgement = judge(np.full(40, 0.2, np.float32), in_sequence(40), CALIBRATION, NEARBY)
    assert judgement.verdict == "unknown"
    assert np.isfinite(judgement.decision or 0)


def test_after_a_second_stage_the_lead_over_the_examined_counts() -> None:
    scores = falling(0.6, 0.2, 0.2, 0.2, 0.2, 0.2)
    one = judge(scores, in_sequence(6, [0, 10, 20, 30, 40, 50]), CALIBRATION, NEARBY, examined=30)
    assert one.decision == pytest.approx((0.6 * 0.4) ** 0.5, abs=1e-5)
    # What was not examined has a lower score by nature and says nothing.
    unexamined = np.concatenate([scores, np.full(50, -0.5, np.float32)])
    places = in_sequence(56, [10 * n for n in range(56)])
    assert judge(unexamined, places, CALIBRATION, NEARBY, examined=6).decision == pytest.approx(one.decision)


def test_a_twin_of_the_best_place_leaves_it_ambiguous_and_not_unknown() -> None:
    rest = [0.1] * 10
    places = in_sequence(12, [20 * n for n in range(12)])
    calibration = CALIBRATION.model_copy(update={"threshold": 0.4, "margin": 0.02})
    assert judge(falling(0.6, 0.6, *rest), places, calibration, NEARBY, examined=30).verdict == "ambiguous"


CURVED = Calibration(
    source="x",
    threshold=0.2,
    margin=0.02,
    background_mean=0.02,
    background_deviation=0.01,
    curve=Curve(slope=20, intercept=-4),
    decision="leading",
)


def test_a_calibration_without_a_curve_gives_no_probability() -> None:
    rest = [0.03 - 0.0001 * i for i in range(60)]
    judgement = judge(falling(0.5, *rest), in_sequence(61), CALIBRATION, Neighborhood(5, 0))
    assert judgement.verdict == "recognized" and judgement.probability is None


def test_a_calibration_with_another_decision_value_is_refused() -> None:
    with pytest.raises(ValidationError, match="decision"):
        Calibration.model_validate(CURVED.model_dump() | {"decision": "by-stage"})


def test_the_probability_is_that_of_the_curve_and_half_of_it_for_twins() -> None:
    rest = [0.1] * 20
    alone = judge(falling(0.6, *rest), in_sequence(21), CURVED, Neighborhood(5, 0))
    assert alone.decision is not None and CURVED.curve is not None
    assert alone.probability == pytest.approx(CURVED.curve.probability(alone.decision))
    twins = judge(falling(0.6, 0.6, *rest), in_sequence(22), CURVED, Neighborhood(5, 0))
    assert twins.decision is not None
    assert twins.verdict == "ambiguous"
    assert twins.probability == pytest.approx(CURVED.curve.probability(twins.decision) / 2)


@given(st.floats(0, 2), st.floats(0, 0.1), st.floats(0, 2), st.floats(0, 0.1))
def test_a_better_answer_is_never_less_probable(a: float, b: float, more: float, further: float) -> None:
    less, better = probability_of(a, b, CURVED), probability_of(a + more, b + further, CURVED)
    assert less is not None and better is not None
    assert 0 < less <= better < 1


def test_the_best_part_of_a_ranking_says_the_same_as_all_of_it() -> None:
    """An index that returns its hundred best changes neither decision nor verdict, with one stage or two."""
    scores = np.sort(np.random.default_rng(0).normal(0.05, 0.02, 5000).astype(np.float32))[::-1]
    scores[0] = 0.5
    places = in_sequence(5000, [10 * n for n in range(5000)])
    for examined in (0, 30):
        whole = judge(scores, places, CURVED, NEARBY, examined)
        assert judge(scores[:100], places.take(np.arange(100)), CURVED, NEARBY, examined) == whole
        assert whole.verdict == "recognized"


def test_which_places_were_examined_may_be_said_one_by_one() -> None:
    scores, places = falling(0.6, 0.5, 0.2, 0.1), in_sequence(4, [0, 10, 20, 30])
    mask = np.array([True, False, True, True])
    judgement = judge(scores, places, CURVED, NEARBY, mask)
    expected = judge(falling(0.6, 0.2, 0.1), in_sequence(3, [0, 20, 30]), CURVED, NEARBY, 3)
    assert judgement.decision == pytest.approx(expected.decision)
    assert judgement.margin == pytest.approx(0.1)


SMALL = CURVED.model_copy(
    update={
        "threshold": 0.09,
        "margin": 0.004,
        "environment": Environment(mean=0.13, deviation=0.034, mean_weight=0.66, deviation_weight=6.6),
        "curve": Curve(slope=37, intercept=-3.5, imagined_slope=-28, imagined_intercept=3),
    }
)


def alone(n: int) -> Whereabouts:
    """Places with neither a pose nor a sequence."""
    return Whereabouts(np.zeros(n, np.int8), np.zeros((n, 3)), np.full(n, NO_SEQUENCE, np.int32), np.arange(n))


def test_places_without_pose_and_sequence_are_places_of_their_own() -> None:
    assert alone(3).near(1, NEARBY).tolist() == [False, True, False]
    with_poses = at([(0, 0), (3, 0), (8, 0)])
    without_sequence = replace(with_poses, sequence=np.full(3, NO_SEQUENCE, np.int32))
    assert without_sequence.near(0, NEARBY).tolist() == [True, True, False]


def test_in_a_map_of_one_place_only_a_high_score_is_recognized() -> None:
    """0.2 is what another place of one corridor scores: there it says nothing, in a full map of streets it says all."""
    assert judge(falling(0.2), alone(1), SMALL, NEARBY).verdict == "unknown"
    rest = np.sort(np.random.default_rng(0).normal(0.09, 0.02, 200))[::-1].astype(np.float32)
    full = judge(np.append(np.float32(0.22), rest), in_sequence(201, [10 * n for n in range(201)]), SMALL, NEARBY)
    assert full.verdict == "recognized" and full.imagined == 0
    certain = judge(falling(0.8), alone(1), SMALL, NEARBY)
    assert certain.verdict == "recognized" and certain.imagined == 1
    unsure = judge(falling(0.2), alone(1), SMALL, NEARBY)
    assert unsure.probability is not None and certain.probability is not None
    assert 0.05 < unsure.probability < 0.5 < certain.probability < 0.999


def test_two_places_of_one_picture_are_ambiguous_and_one_group() -> None:
    judgement = judge(falling(0.85, 0.85), alone(2), SMALL, NEARBY, likeness=lambda at: np.full(len(at), 0.86))
    assert judgement.verdict == "ambiguous"
    assert judgement.rivals == (Rivals((1,), True),)
    assert judgement.probability is not None and judgement.probability <= 0.5


def twice(count: int = 60) -> Whereabouts:
    """Sixty places of one sequence, and the same of another; the first two of the ranking are counterparts."""
    order = np.repeat(np.arange(count) * 10, 2)
    return Whereabouts(np.zeros(2 * count, np.int8), np.zeros((2 * count, 3)), np.tile([0, 1], count), order)


def likeness_of(counterparts: set[int]) -> Likeness:
    return lambda at: np.array([0.7 if position in counterparts else 0.15 for position in at.tolist()], np.float32)


def test_rivals_of_another_traverse_explain_that_nothing_stands_out() -> None:
    scores = np.concatenate([falling(0.25, 0.245, 0.24), np.linspace(0.15, 0.05, 117, dtype=np.float32)])
    places = twice()
    calibration = SMALL.model_copy(update={"threshold": 0.145})
    plain = judge(scores, places, calibration, NEARBY)
    assert plain.verdict == "unknown" and plain.rivals == (), "nothing says that the rivals show the same place"
    known = judge(scores, places, calibration, NEARBY, likeness=likeness_of({1, 2}))
    assert (known.verdict, known.rivals) == ("ambiguous", (Rivals((1, 2), True),))
    assert known.decision == plain.decision and known.probability == plain.probability


def test_rivals_do_not_make_a_stranger_ambiguous() -> None:
    scores = np.linspace(0.16, 0.05, 120, dtype=np.float32)
    asked: list[int] = []

    def likeness(at: NDArray[np.int64]) -> NDArray[np.float32]:
        asked.extend(at.tolist())
        return np.full(len(at), 0.7, np.float32)

    assert judge(scores, twice(), SMALL, NEARBY, likeness=likeness).verdict == "unknown"
    assert asked == [], "it would not stand out without rivals either, so none is looked at"


def test_another_place_that_looks_like_the_query_is_a_group_of_its_own() -> None:
    scores = np.concatenate([falling(0.5, 0.499), np.linspace(0.1, 0.05, 118, dtype=np.float32)])
    judgement = judge(scores, twice(), SMALL, NEARBY, likeness=likeness_of(set()))
    assert (judgement.verdict, judgement.rivals) == ("ambiguous", (Rivals((1,), False),))


def test_a_calibration_of_the_first_release_is_read_and_means_what_it_meant() -> None:
    stored = (
        '{"source": "measured", "threshold": 0.2, "margin": 0.01, "background_mean": 0.07,'
        ' "background_deviation": 0.01, "curve": {"slope": 30.0, "intercept": -4.0}, "decision": "leading"}'
    )
    calibration = Calibration.model_validate_json(stored)
    judgement = judge(falling(0.3, 0.1), in_sequence(2, [0, 50]), calibration, NEARBY)
    top = (0.1 + 4 * 0.07) / 5
    assert judgement.decision == pytest.approx(np.sqrt(0.3 * (0.3 - top)), abs=1e-4)
    assert judgement.imagined == 0
    with pytest.raises(ValidationError, match="imagined_slope"):
        Curve(slope=10, intercept=0, imagined_slope=-10)
