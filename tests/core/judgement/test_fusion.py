"""Cameras of a rig and maps side by side: evidence added up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.judgement.fusion import BLIND, CameraRanking, Fused, fuse, joint_probabilities, log_odds_of, witnesses
from core.judgement.geometry import TERMS, Geometry
from core.judgement.probability import Curve, sigmoid
from core.judgement.verdict import Calibration, Judgement, judge
from core.places import Neighborhood, Pose
from tests.core.judgement.test_priors import places

CALIBRATION = Calibration(
    source="test", threshold=0.2, margin=0.01, background_mean=0.1, background_deviation=0.02,
    curve=Curve(slope=20, intercept=-4), decision="leading",
)  # fmt: skip
NEIGHBORHOOD = Neighborhood(radius=1.0, frames=0)


def view(scores: dict[int, float], weights: dict[int, float] | None = None) -> CameraRanking:
    """Of places ten metres apart, by row."""
    rows = sorted(scores, key=lambda row: -scores[row])
    return CameraRanking(
        np.array(rows),
        np.array([scores[row] for row in rows], np.float32),
        places([Pose(x=10 * row, y=0) for row in rows]),
        np.ones(len(rows), np.bool_),
        None if weights is None else np.array([weights[row] for row in rows]),
    )


def fused(*views: CameraRanking) -> Fused:
    return fuse(views, CALIBRATION, NEIGHBORHOOD)


BACKGROUND = {row: 0.1 + 0.001 * row for row in range(10, 18)}


def test_one_camera_is_a_plain_query() -> None:
    one = view({3: 0.5, **BACKGROUND})
    alone = judge(one.scores, one.whereabouts, CALIBRATION, NEIGHBORHOOD, one.examined)
    found = fused(one)
    assert found.rows.tolist() == one.rows.tolist()
    assert found.judgement.verdict == alone.verdict == "recognized"
    assert found.judgement.decision == pytest.approx(alone.decision, rel=1e-5)
    assert found.judgement.score == alone.score


def test_two_that_agree_are_surer_than_either() -> None:
    left, right = view({3: 0.32, **BACKGROUND}), view({3: 0.33, **BACKGROUND})
    together = fused(left, right).judgement
    for one in (left, right):
        alone = fused(one).judgement
        assert alone.probability is not None and together.probability is not None
        assert together.probability > alone.probability
    assert together.verdict == "recognized"


def test_a_camera_that_sees_nothing_spoils_nothing() -> None:
    clear, covered = view({3: 0.6, **BACKGROUND}), view(BACKGROUND)
    found = fused(clear, covered)
    assert found.judgement.verdict == "recognized" and found.rows[0] == 3
    assert found.log_odds[0] > fused(clear).log_odds[0] + np.log(BLIND) + np.log(1 - BLIND)


def test_twins_of_storeys_that_all_cameras_see_are_ambiguous_until_a_prior_tells_them() -> None:
    scores = {3: 0.5, 5: 0.45, **BACKGROUND}
    one = replace(view(scores), twins=(5,))
    other = view({3: 0.52, 5: 0.4, **BACKGROUND})
    found = fused(one, replace(other, twins=(5,))).judgement
    assert found.verdict == "ambiguous" and found.probability == 0.5
    assert [list(rival.positions) for rival in found.rivals] == [list(found.twins)]
    assert fused(one, other).judgement.verdict == "recognized", "the second camera tells them apart"
    weights = dict.fromkeys(scores, 0.0) | {5: -2.0}
    stated = [replace(view(seen, weights), twins=(5,)) for seen in (scores, {3: 0.52, 5: 0.4, **BACKGROUND})]
    assert fused(*stated).judgement.verdict == "recognized"


def test_two_that_contradict_each_other_are_ambiguous() -> None:
    found = fused(view({3: 0.5, **BACKGROUND}), view({5: 0.5, **BACKGROUND}))
    assert found.judgement.verdict == "ambiguous" and set(found.rows[:2].tolist()) == {3, 5}
    assert found.judgement.probability is not None and found.judgement.probability <= 0.5
    assert [(found.rows[list(one.positions)].tolist(), one.same_place) for one in found.judgement.rivals] == [
        ([int(found.rows[1])], False)
    ]
    assert not fused(view({3: 0.5, **BACKGROUND})).judgement.rivals


def test_what_a_camera_recognizes_with_fewer_stages_contradicts_as_well() -> None:
    weak = view({5: 0.15, **BACKGROUND})
    assert fused(view({3: 0.6, **BACKGROUND}), weak).judgement.verdict == "recognized"
    found = fused(view({3: 0.6, **BACKGROUND}), replace(weak, recognized=5))
    assert found.judgement.verdict == "ambiguous"
    assert [found.rows[list(one.positions)].tolist() for one in found.judgement.rivals] == [[5]]


def verified(one: CameraRanking, evidence: dict[int, float]) -> CameraRanking:
    """A camera whose candidates were verified, with the evidence of some rows; a hundredth of it is their gain."""
    found = np.array([evidence.get(row, np.nan) for row in one.rows.tolist()])
    return replace(one, geometry=Geometry(found, np.nan_to_num(found) / 1000))


def test_the_evidence_of_a_camera_joins_its_log_odds() -> None:
    weighing = CALIBRATION.model_copy(update={"geometry": TERMS})
    plain = view({3: 0.32, **BACKGROUND})
    before = fuse([plain], weighing, NEIGHBORHOOD)
    fits, fails = (fuse([verified(plain, {3: evidence})], weighing, NEIGHBORHOOD) for evidence in (300.0, 0.0))
    assert before.rows[0] == fits.rows[0] == 3
    assert fits.log_odds[0] == pytest.approx(float(TERMS.log_odds(before.log_odds[0], 300.0, 1.0)))
    assert fails.log_odds[0] == pytest.approx(float(TERMS.log_odds(before.log_odds[0], 0.0, 1.0)))
    assert fits.judgement.verdict == "recognized" and fits.judgement.evidence == 300.0
    assert fails.judgement.verdict == "unknown" and before.judgement.evidence is None
    assert fits.scores[0] == pytest.approx(0.62)


def of_frame(one: CameraRanking, *components: float) -> CameraRanking:
    """The ranking of a camera whose frame has a descriptor."""
    return replace(one, descriptor=np.array(components, np.float32))


@pytest.mark.parametrize("evidence", [None, {3: 300.0, 4: 280.0, **dict.fromkeys(BACKGROUND, 5.0)}])
def test_a_camera_doubled_says_what_it_says_alone(evidence: dict[int, float] | None) -> None:
    """Also where a place five metres on looks nearly the same."""
    weighing = CALIBRATION.model_copy(update={"geometry": TERMS})
    one = of_frame(view({3: 0.5, 4: 0.47, **BACKGROUND}), 3.0, 4.0)
    if evidence is not None:
        one = verified(one, evidence)
    alone, doubled = (fuse([one] * cameras, weighing, NEIGHBORHOOD) for cameras in (1, 2))
    order = np.argsort(-one.values)
    parts = one.scores[order], one.whereabouts.take(order), weighing, NEIGHBORHOOD, one.examined
    plain = judge(*parts, geometry=None if one.geometry is None else one.geometry.take(order))
    assert doubled.judgement.verdict == alone.judgement.verdict == plain.verdict == "recognized"
    assert doubled.judgement.probability == pytest.approx(alone.judgement.probability)
    assert plain.probability == pytest.approx(alone.judgement.probability)
    assert doubled.rows.tolist() == alone.rows.tolist()


def test_a_camera_counts_by_what_the_others_do_not_show() -> None:
    left, right = of_frame(view({3: 0.32, **BACKGROUND}), 1.0, 0.0), view({3: 0.33, **BACKGROUND})
    same, like, other = (
        fused(left, of_frame(right, np.cos(angle), np.sin(angle))).log_odds[0] for angle in (0.0, 0.7, np.pi / 2)
    )
    assert same == pytest.approx(fused(right).log_odds[0])
    assert same < like < other == pytest.approx(fused(left).log_odds[0] + fused(right).log_odds[0])


def test_a_blocked_camera_and_one_that_repeats_another_say_nothing() -> None:
    clear, covered = view({3: 0.6, **BACKGROUND}), view({3: 0.06, **dict.fromkeys(BACKGROUND, 0.05)})
    assert witnesses([covered, clear], CALIBRATION) == [1]
    assert witnesses([covered, covered], CALIBRATION) == [0]
    first, second = of_frame(clear, 0.0, 2.0), of_frame(view({5: 0.4, **BACKGROUND}), 2.0, 0.0)
    assert witnesses([first, second, first], CALIBRATION) == [0, 1]


@pytest.mark.parametrize("sureness", [0.45, 0.6, 0.9])
def test_however_sure_one_of_two_is_that_contradict_each_other(sureness: float) -> None:
    found = fused(view({3: sureness, **BACKGROUND}), view({5: 0.4, **BACKGROUND}))
    assert found.judgement.verdict == "ambiguous" and found.rows[0] == 3
    assert found.judgement.probability is not None and found.judgement.probability <= 0.5
    assert [found.rows[list(one.positions)].tolist() for one in found.judgement.rivals] == [[5]]


def test_geometry_settles_what_two_cameras_disagree_about() -> None:
    """The right camera prefers another place in score; its keypoints fit the one that the left camera knows."""
    weighing = CALIBRATION.model_copy(update={"geometry": TERMS})
    left = verified(view({3: 0.5, **BACKGROUND}), {3: 300.0})
    right = view({5: 0.42, 3: 0.36, **BACKGROUND})
    assert fuse([left, right], CALIBRATION, NEIGHBORHOOD).judgement.verdict == "ambiguous"
    settled = fuse([left, verified(right, {3: 200.0, 5: 0.0})], weighing, NEIGHBORHOOD)
    assert settled.rows[0] == 3 and settled.judgement.verdict == "recognized"


def test_of_places_that_fit_one_has_to_lead_by_the_margin() -> None:
    """Whatever shares the view fits: what stands a little farther is no reason for doubt, but a place as likely is."""
    weighing = CALIBRATION.model_copy(update={"geometry": TERMS})
    scores = {3: 0.5, 5: 0.499, **BACKGROUND}
    for evidence, verdict in ((60.0, "recognized"), (298.0, "ambiguous")):
        cameras = [verified(view(scores), {3: 300.0, 5: evidence})] * 2
        found = fuse(cameras, weighing, NEIGHBORHOOD)
        assert found.rows.tolist()[:2] == [3, 5] and found.judgement.verdict == verdict


@given(st.lists(st.lists(st.floats(0.1, 0.9), min_size=10, max_size=10), min_size=1, max_size=3))
def test_verdict_and_probability_never_disagree(cameras: list[list[float]]) -> None:
    judgement = fused(*[view(dict(enumerate(scores))) for scores in cameras]).judgement
    assert judgement.probability is not None and CALIBRATION.curve is not None
    if judgement.verdict == "ambiguous":
        assert judgement.probability <= 0.5
    if judgement.verdict == "recognized":
        assert judgement.probability >= CALIBRATION.curve.probability(CALIBRATION.threshold)


def test_what_each_takes_for_one_of_two_both_take_for_the_third() -> None:
    """Each camera prefers a place that the other rules out; the one that both know is second for both."""
    found = fused(view({1: 0.42, 3: 0.4, **BACKGROUND}), view({2: 0.42, 3: 0.4, **BACKGROUND}))
    assert found.rows[0] == 3


def test_strangers_together_stay_strangers() -> None:
    found = fused(*[view(BACKGROUND) for _ in range(4)])
    assert found.judgement.verdict == "unknown"


def test_a_prior_counts_once_for_all_cameras() -> None:
    scores = {3: 0.5, 4: 0.5, **BACKGROUND}
    weights = {row: (0.0 if row == 3 else -2.0) for row in scores}
    found = fused(view(scores, weights), view(scores, weights))
    assert found.rows[0] == 3
    assert found.log_odds[0] - found.log_odds[1] == pytest.approx(2.0, abs=1e-4)


def test_at_most_one_of_several_maps_is_right() -> None:
    assert joint_probabilities([2.0])[0] == pytest.approx(sigmoid(np.array(2.0)))
    both = joint_probabilities([2.0, 2.0])
    assert both.sum() < 1 and both[0] == both[1] < 0.5
    assert joint_probabilities([900.0, -900.0])[0] == pytest.approx(1)
    assert joint_probabilities([30.0, 30.0]).tolist() == pytest.approx([0.5, 0.5])


def test_log_odds_of_a_judgement() -> None:
    judged = Judgement("recognized", 0.5, 0.3, 0.1, 1, 0.9)
    assert log_odds_of(judged, CALIBRATION) == pytest.approx(np.log(9))
    bare = Judgement("recognized", 0.5, 0.3, 0.1, 1, None)
    assert log_odds_of(bare, CALIBRATION) == pytest.approx(2)
    assert log_odds_of(Judgement("unknown", None, None, None, None), CALIBRATION) < -30
