"""The score from which on a look is believed, by frames of its run from elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.judgement.verdict import Calibration
from core.learning import Trail, cohort_of, least_score
from core.learning.cohort import LEAST_COHORT, STRICTER
from tests.core.learning.runs import except_at, walked, way

CALIBRATION = Calibration(source="made up", threshold=0.2, margin=0.02, background_mean=0.0, background_deviation=0.05)


def test_the_cohort_is_elsewhere_by_odometry() -> None:
    frames = walked(range(50), except_at([]), drift=0.0)
    frames[40] = replace(frames[40], sight="constant")
    found = cohort_of(Trail.of(frames), 20, way(60))
    assert found.beside.tolist() == [13, 14, 15, 16, 24, 25, 26, 27]  # 6 to 15 m, as the robot goes
    assert {12, 28, 49} <= set(found.far.tolist())
    assert 40 not in found.far
    assert {19, 20, 21, 22, 23}.isdisjoint([*found.far, *found.beside])


def test_frames_after_odometry_began_anew_are_not_known_to_be_elsewhere() -> None:
    frames = walked(range(50), except_at([]))
    frames[25:] = [replace(one, pose=replace(one.pose, origin="anew")) if one.pose else one for one in frames[25:]]
    found = cohort_of(Trail.of(frames), 20, way(60))
    assert found.far.max() < 25


def test_a_robot_that_comes_back_is_no_cohort_of_itself() -> None:
    frames = walked([*range(30), *range(28, -1, -1)], except_at([]), drift=0.0)
    found = cohort_of(Trail.of(frames), 10, way(60))
    assert {48, 49}.isdisjoint([*found.far, *found.beside])


def test_a_look_is_believed_above_its_cohort_alone() -> None:
    random = np.random.default_rng(2)
    far = random.normal(0.1, 0.02, 60)
    least = least_score(np.zeros(0), far, CALIBRATION)
    assert least is not None and least > far.max()
    s = least / STRICTER
    top = np.sort(far)[-5:].mean()
    assert s * (s - top) == pytest.approx(CALIBRATION.threshold**2, rel=1e-6)
    nightly = least_score(np.zeros(0), far + 0.3, CALIBRATION)
    assert nightly is not None and nightly > least
    assert least_score(np.array([0.9, 0.2]), far, CALIBRATION) == 0.9


def test_a_small_cohort_knows_nothing() -> None:
    assert least_score(np.ones(50), np.ones(LEAST_COHORT - 1), CALIBRATION) is None
