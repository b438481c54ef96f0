"""Poses from matches: on the circle, around the globe, and never the middle of two far places."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.judgement.position import PoseEstimate, circular_mean, estimate_pose
from core.places import EARTH_RADIUS, Pose
from tests.core.judgement.test_priors import places

REACH = 5.0


def estimate(poses: list[Pose | None], log_weights: list[float] | None = None, reach: float = REACH) -> PoseEstimate:
    found = estimate_pose(places(poses), log_weights or [0.0] * len(poses), reach)
    assert found is not None
    return found


@given(st.lists(st.floats(0, 359.99), min_size=1, max_size=8), st.floats(-360, 360))
def test_the_mean_turns_with_what_it_is_the_mean_of(angles: list[float], turn: float) -> None:
    weights = np.arange(1, len(angles) + 1)
    mean, spread = circular_mean(angles, weights)
    turned, same_spread = circular_mean(np.add(angles, turn), weights)
    if spread < 150:  # beyond, the mean is decided by rounding
        assert abs((turned - mean - turn + 180) % 360 - 180) < 1e-6
        assert same_spread == pytest.approx(spread, abs=1e-6)


def test_the_mean_of_directions() -> None:
    assert circular_mean([350, 10], [1, 1])[0] % 360 == pytest.approx(0, abs=1e-9)
    assert circular_mean([90], [1]) == pytest.approx((90, 0), abs=1e-5)
    assert circular_mean([0, 90], [1, 0])[0] == pytest.approx(0)
    assert circular_mean([10, 50], [3, 1])[0] < 30
    assert circular_mean([0, 180], [1, 1])[1] > 1e2


def test_a_mean_weighted_by_odds() -> None:
    found = estimate([Pose(x=0, y=0, heading=350), Pose(x=4, y=0, heading=10)], [math.log(3), 0.0])
    assert [found.pose.x, found.pose.y] == pytest.approx([1, 0]) and found.places == 2
    assert found.pose.heading == pytest.approx(355, abs=0.2)
    # Σ w d² = 3/4 · 1² + 1/4 · 3², and half the gap of 4 m.
    assert found.spread == pytest.approx(math.sqrt(3 + 4))
    assert found.heading_spread is not None and 5 < found.heading_spread < 15


def test_a_far_place_that_looks_alike_is_no_part_of_it() -> None:
    found = estimate([Pose(x=0, y=0), Pose(x=500, y=0), Pose(x=1, y=0)])
    assert found.pose.x == pytest.approx(0.5) and found.places == 2


def test_one_place_alone_is_not_exact() -> None:
    found = estimate([Pose(x=3, y=4, heading=90)])
    assert (found.pose.x, found.pose.y, found.pose.heading) == (3, 4, 90)
    assert (found.spread, found.heading_spread, found.places) == (REACH / 2, None, 1)


def test_no_better_than_the_distance_of_the_places() -> None:
    found = estimate([Pose(x=0, y=0), Pose(x=2, y=0)], [0.0, -30.0])
    assert found.pose.x == pytest.approx(0) and found.spread == pytest.approx(1)


def test_no_pose_without_poses() -> None:
    assert estimate_pose(places([None, Pose(x=0, y=0)]), [0, 0], REACH) is None
    assert estimate_pose(places([]), [], REACH) is None
    mixed = estimate([Pose(x=0, y=0), None, Pose(latitude=0, longitude=0)])
    assert mixed.places == 1


@given(st.floats(-89.9, 89.9), st.floats(-180, 180), st.floats(0, 359))
def test_anywhere_on_the_earth(latitude: float, longitude: float, heading: float) -> None:
    """Two places three metres apart along a meridian, and across ±180° as anywhere."""
    step = math.degrees(3 / EARTH_RADIUS)
    aside = (longitude + 540) % 360 - 180
    poses: list[Pose | None] = [
        Pose(latitude=latitude, longitude=longitude, heading=heading),
        Pose(latitude=latitude + step, longitude=aside, heading=heading),
    ]
    found = estimate(poses)
    expected = Pose(latitude=latitude + step / 2, longitude=longitude)
    assert np.linalg.norm(found.pose.position() - expected.position()) < 1e-3
    assert found.pose.heading is not None
    assert abs((found.pose.heading - heading + 180) % 360 - 180) < 0.1
    assert found.spread == pytest.approx(math.sqrt(1.5**2 + 1.5**2), rel=1e-3)


def test_across_the_antimeridian() -> None:
    step = math.degrees(1 / EARTH_RADIUS)
    found = estimate([Pose(latitude=0, longitude=180 - step), Pose(latitude=0, longitude=-180 + step)])
    assert abs(found.pose.longitude or 0) == pytest.approx(180, abs=1e-9)
    assert found.pose.latitude == pytest.approx(0, abs=1e-9)


def test_over_the_pole_a_heading_is_a_direction_in_space() -> None:
    """Both face along the meridian 0° / 180° the same way: over the pole that is north before it and south behind."""
    step = math.degrees(2 / EARTH_RADIUS)
    found = estimate(
        [Pose(latitude=90 - step, longitude=0, heading=0), Pose(latitude=90 - 0.9 * step, longitude=180, heading=180)],
        [0.5, 0.0],
    )
    assert found.pose.latitude == pytest.approx(90, abs=step)
    assert found.heading_spread == pytest.approx(0, abs=1e-3)


def test_headings_that_cancel_out_are_none() -> None:
    found = estimate([Pose(x=0, y=0, heading=0), Pose(x=1, y=0, heading=180)])
    assert found.pose.heading is None and found.heading_spread is None
