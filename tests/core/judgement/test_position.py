"""Poses from matches: on the circle, around the globe, and never the middle of two far places."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.geometry.bundle import DECLINE, Stand
from core.geometry.pose import RelativeView, SharedPoints
from core.judgement.position import (
    BUNDLE_REACH,
    TURN,
    UNKNOWN_ANGLE,
    UNKNOWN_HEIGHT,
    WIDEST_GAP,
    PlaceErrors,
    PoseEstimate,
    circular_mean,
    estimate_pose,
    gap_around,
    places_apart,
)
from core.places import EARTH_RADIUS, Pose, Whereabouts
from tests.core.geometry.test_bundle import sightings, stand
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
        assert same_spread == pytest.approx(spread, abs=1e-5)  # near zero it is the root of a rounding error


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
    assert (found.spread, found.heading_spread, found.places) == (WIDEST_GAP / 2, None, 1)
    assert estimate([Pose(x=3, y=4)], reach=40).spread == 20


def test_places_beyond_the_reach_say_how_far_a_place_stands_for_all_around() -> None:
    """A frame from anywhere up to halfway to the next place shows this one; from farther off none is recognized."""
    for apart, gap in ((3.0, 3.0), (12.0, 12.0), (500.0, WIDEST_GAP)):
        found = estimate([Pose(x=0, y=0), Pose(x=apart, y=0)], [0.0, -30.0])
        assert found.pose.x == pytest.approx(0, abs=1e-6) and found.spread == pytest.approx(gap / 2)
        assert found.covariance[0, 0] == pytest.approx(gap**2 / 8, rel=0.01)


def beside(second: float) -> Whereabouts:
    """A traverse with a place every 5 m, and another one beside it, which begins 0.3 m aside and some way ahead."""
    poses = [Pose(x=5.0 * number, y=0) for number in (2, 0, 1, 3, 4)]
    poses += [Pose(x=5.0 * number + second, y=0.3) for number in range(5)]
    return replace(places(list(poses)), sequence=np.repeat([0, 1], 5).astype(np.int32))


@pytest.mark.parametrize("second", [0.0, 0.001, 2.0])
def test_a_traverse_beside_it_does_not_say_where_between_its_places_a_frame_was_taken(second: float) -> None:
    found = estimate_pose(beside(second), [0] + [-30] * 9, REACH)
    assert found is not None and found.spread == pytest.approx(2.5)
    alone = places([Pose(x=0, y=0), Pose(x=0.001, y=0), Pose(x=3, y=0)])
    assert gap_around(alone, REACH) == pytest.approx(3), "looks whose poses differ a little are at one place"
    assert gap_around(places([Pose(x=0, y=0), Pose(x=0, y=0)]), REACH) == WIDEST_GAP


def test_places_that_tell_how_far_stand_apart() -> None:
    assert places_apart(beside(0.0), REACH, range(10), 4) == [1, 2, 3, 4]
    assert places_apart(beside(0.0), REACH, [7, 6, 2, 8], 2) == [6, 8], "7 is beside the best match, 2 beside 6"
    far = places([Pose(x=0, y=0), Pose(x=BUNDLE_REACH + 1, y=0), None, Pose(latitude=0, longitude=0)])
    assert places_apart(far, REACH, range(4), 3) == []


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


def rotated(degrees: float) -> NDArray[np.float64]:
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def view_from(
    place: Pose, x: float, y: float, heading: float, distance: float, random: np.random.Generator | None = None
) -> RelativeView:
    """How a camera at x, y stands to a place's, in units of the distance, with errors as it says."""
    turn, shift = 0.02, 0.01
    covariance = np.diag([turn**2] * 3 + [shift**2] * 3)
    errors = np.zeros(6) if random is None else random.normal(size=6) * np.sqrt(np.diag(covariance))
    assert place.x is not None and place.y is not None and place.heading is not None
    offset = rotated(-place.heading) @ np.array([x - place.x, y - place.y, 0]) / distance + errors[3:]
    degrees = heading - place.heading + math.degrees(errors[2])
    return RelativeView(rotated(degrees), offset, covariance, 100, "intrinsics")


def test_the_covariance_without_views_is_that_of_the_places_and_their_distance() -> None:
    found = estimate([Pose(x=0, y=0, heading=90), Pose(x=4, y=0, heading=90)], [math.log(3), 0.0])
    assert found.source == "places" and found.heading_offset is None and found.offset_spread is None
    assert found.covariance == pytest.approx(found.covariance.T)
    # Half the square of half the gap in each direction, and 3/4 · 1² + 1/4 · 3² along the places.
    assert found.covariance[0, 0] == pytest.approx(3 + 2, rel=0.01)
    assert found.covariance[1, 1] == pytest.approx(2, rel=0.01)
    assert found.covariance[3, 3] == found.covariance[4, 4] == UNKNOWN_ANGLE
    assert 15 < math.degrees(math.sqrt(found.covariance[5, 5])) < 30
    assert estimate([Pose(x=0, y=0)]).covariance[5, 5] == UNKNOWN_ANGLE
    assert found.without_height().covariance[2].tolist() == [0, 0, UNKNOWN_HEIGHT, 0, 0, 0]
    assert found.without_height().pose.z is None


@pytest.mark.parametrize("distance", [3.0, 8.0, 25.0])
def test_two_views_put_the_query_between_their_places(distance: float) -> None:
    poses: list[Pose | None] = [Pose(x=0, y=0, heading=0), Pose(x=4, y=0, heading=10)]
    views = [view_from(pose, 3, -0.5, 15, distance) for pose in poses if pose is not None]
    found = estimate_pose(places(poses), [0, 0], REACH, views=views)
    assert found is not None and found.source == "intrinsics" and found.places == 2
    assert [found.pose.x, found.pose.y] == pytest.approx([3, -0.5], abs=0.6)
    assert found.pose.heading == pytest.approx(15, abs=1) and found.heading_offset == pytest.approx(15)
    assert found.spread < estimate(poses).spread
    assert found.heading_spread is not None and 1 < found.heading_spread < 4


def test_one_view_says_where_to_and_not_how_far() -> None:
    place = Pose(x=10, y=5, heading=90)
    found = estimate_pose(places([place]), [0], REACH, views=[view_from(place, 10, 6.5, 80, 8)])
    assert found is not None and found.heading_offset == pytest.approx(-10)
    assert found.pose.heading == pytest.approx(80, abs=2)
    assert found.covariance[1, 1] > 4 * found.covariance[0, 0]  # along the shift, which is to +y
    assert found.pose.y is not None and found.pose.y > 5.3


@pytest.mark.parametrize("distance", [4.0, 8.0, 24.0])
def test_far_from_all_places_the_distance_of_the_scene_is_open(distance: float) -> None:
    """Places are 14 m apart, beyond the reach, and the query is 5 m ahead of one of them."""
    poses: list[Pose | None] = [Pose(x=14.0 * number, y=0, heading=0) for number in range(3)]
    view = view_from(Pose(x=0, y=0, heading=0), 5, 0, 0, distance)
    found = estimate_pose(places(poses), [0, -3, -6], REACH, views=[view])
    assert found is not None and found.pose.x is not None and found.pose.y is not None
    assert abs(found.pose.x - 5) < 2.2 * math.sqrt(found.covariance[0, 0])
    assert 1 < math.sqrt(found.covariance[0, 0]) < 5
    assert abs(found.pose.y) < 0.6 and math.sqrt(found.covariance[1, 1]) < 0.7


def test_a_view_of_few_matches_moves_the_position_little() -> None:
    """From far away most of them are wrong; the turn is mostly right all the same."""
    place = Pose(x=0, y=0, heading=0)
    view = view_from(place, 5, 0, 10, 8)
    found = [
        estimate_pose(places([place]), [0], REACH, views=[replace(view, share=share)]) for share in (0.08, 0.115, 0.3)
    ]
    far, half, near = (one for one in found if one is not None)
    assert 0 < far.pose.x < half.pose.x < near.pose.x  # type: ignore[operator]
    assert half.pose.x == pytest.approx(near.pose.x / 2, rel=0.01)  # type: ignore[operator]
    assert far.covariance[1, 1] > half.covariance[1, 1] > 4 * near.covariance[1, 1]
    assert far.pose.heading == pytest.approx(near.pose.heading) and far.heading_spread == near.heading_spread
    assert all(np.linalg.eigvalsh(one.covariance).min() > 0 for one in (far, half, near))


@pytest.mark.parametrize("count", [30, 60, 90])
def test_fewer_points_are_shared_from_farther_away(count: int) -> None:
    """Where the ratio of distances from two places is that of their counts to the power of 1.5."""
    poses: list[Pose | None] = [Pose(x=0, y=0, heading=0), Pose(x=14, y=0, heading=0)]
    ratio = (count / 100) ** DECLINE
    there = 14 * ratio / (1 + ratio)
    view = view_from(Pose(x=0, y=0, heading=0), there, 0, 0, 24)
    alone = estimate_pose(places(poses), [0, -3], REACH, views=[view])
    found = estimate_pose(places(poses), [0, -3], REACH, views=[view], sightings=[sharing(100), sharing(count)])
    assert alone is not None and found is not None and alone.pose.x is not None and found.pose.x is not None
    assert found.pose.x == pytest.approx(there, abs=0.8) and found.spread < alone.spread


def test_places_that_share_no_point_take_no_part() -> None:
    poses: list[Pose | None] = [Pose(x=0, y=0, heading=0), Pose(x=14, y=0, heading=0)]
    view = view_from(Pose(x=0, y=0, heading=0), 5, 0, 0, 24)
    alone = estimate_pose(places(poses), [0, -3], REACH, views=[view])
    assert alone is not None
    none = replace(sharing(20), fitting=np.zeros(20, np.bool_))
    for seen in ([sharing(50), none], [none, sharing(50)], [sharing(50), sharing(0)]):
        found = estimate_pose(places(poses), [0, -3], REACH, views=[view], sightings=seen)
        assert found is not None and found.pose == alone.pose and found.spread == alone.spread


def sharing(count: int) -> SharedPoints:
    """As many points that fit, each of which another place sees as another point."""
    ahead = np.tile([0.0, 0.0, 1.0], (count, 1))
    numbers = np.arange(count) + 1000 * count
    return SharedPoints(numbers, ahead, ahead, np.ones(count, np.bool_), np.ones(count), 1e-3)


@pytest.mark.thorough
def test_the_normalized_error_is_that_of_the_covariance() -> None:
    """200 queries between places, with views whose errors are as large as they say."""
    random = np.random.default_rng(5)
    squares, both = [], [Pose(x=0, y=0, heading=0), Pose(x=3, y=0, heading=0)]
    for _ in range(200):
        x, y, heading = random.uniform(0, 3), random.normal(0, 0.7), random.normal(0, 10)
        distance = math.exp(random.normal(math.log(8), 1))
        views = [view_from(pose, x, y, heading, distance, random) for pose in both]
        found = estimate_pose(places(list(both)), random.normal(size=2), REACH, views=views)
        assert found is not None and found.pose.heading is not None
        assert found.pose.x is not None and found.pose.y is not None
        turn = (found.pose.heading - heading + 180) % 360 - 180
        error = np.array([found.pose.x - x, found.pose.y - y, math.radians(turn)])
        squares.append(float(error @ np.linalg.solve(found.covariance[np.ix_([0, 1, 5], [0, 1, 5])], error)))
    # Views share their errors in part, so the covariance is larger than for independent ones.
    assert 0.3 * 3 < np.mean(squares) < 3.8


def test_without_intrinsics_a_view_turns_and_does_not_shift() -> None:
    place = Pose(x=10, y=5, heading=90)
    view = replace(view_from(place, 10, 6.5, 80, 8), source="field-of-view")
    found, alone = estimate_pose(places([place]), [0], REACH, views=[view]), estimate([place])
    assert found is not None and found.source == "field-of-view"
    assert found.pose.heading == pytest.approx(80, abs=2)
    assert [found.pose.x, found.pose.y] == pytest.approx([alone.pose.x, alone.pose.y], abs=0.05)
    assert found.covariance[:2, :2] == pytest.approx(alone.covariance[:2, :2], rel=0.02, abs=0.02)


def test_a_view_that_contradicts_the_places_is_not_used() -> None:
    pose = Pose(x=0, y=0, heading=0)
    wrong = view_from(pose, 0, 0, 170, 8)
    found = estimate_pose(places([pose]), [0], REACH, views=[wrong])
    assert found is not None and found.source == "places" and found.pose.heading == 0


@pytest.mark.parametrize("heading", [None, 30.0])
def test_places_without_headings_only_have_an_offset(heading: float | None) -> None:
    shown = view_from(Pose(x=0, y=0, heading=0), 1, 0, 12, 8)
    found = estimate_pose(places([Pose(x=0, y=0, heading=heading)]), [0], REACH, views=[shown])
    assert found is not None and found.heading_offset == pytest.approx(12)
    assert (found.pose.heading is None) == (heading is None)
    assert found.source == ("places" if heading is None else "intrinsics")


@pytest.mark.parametrize("latitude", [-60.0, 0.0, 48.0])
def test_on_the_earth_headings_are_clockwise_and_the_covariance_is_not(latitude: float) -> None:
    """The same as in metres: east is x, north is y, and a heading of h is 90° - h from x."""
    north = math.degrees(1 / EARTH_RADIUS)
    flat = Pose(x=0, y=0, heading=60)
    view = view_from(flat, 1, 1, 75, 8)
    there = Pose(latitude=latitude, longitude=10, heading=30)
    on_earth = estimate_pose(places([there]), [0], REACH, views=[view])
    plain = estimate_pose(places([flat]), [0], REACH, views=[view])
    assert on_earth is not None and plain is not None and plain.pose.heading is not None
    assert on_earth.heading_offset == pytest.approx(-15) and plain.heading_offset == pytest.approx(15)
    assert on_earth.pose.heading == pytest.approx(90 - plain.pose.heading, abs=0.01)
    which = np.ix_([0, 1, 5], [0, 1, 5])
    assert on_earth.covariance[which] == pytest.approx(plain.covariance[which], abs=1e-3)
    assert on_earth.covariance[2, 2] == UNKNOWN_HEIGHT
    assert on_earth.pose.latitude is not None and on_earth.pose.longitude is not None
    assert (on_earth.pose.latitude - latitude) / north == pytest.approx(plain.pose.y, abs=0.01)
    east = (on_earth.pose.longitude - 10) / north * math.cos(math.radians(latitude))
    assert east == pytest.approx(plain.pose.x, abs=0.01)


def test_views_of_places_out_of_reach_or_not_verified_take_no_part() -> None:
    poses: list[Pose | None] = [Pose(x=0, y=0, heading=0), Pose(x=90, y=0, heading=0), Pose(x=1, y=0, heading=0)]
    far = view_from(Pose(x=90, y=0, heading=0), 91, 0, 40, 8)
    found = estimate_pose(places(poses), [0, 0, 0], REACH, views=[None, far])
    assert found is not None and found.source == "places" and found.heading_offset is None


@pytest.mark.parametrize("frame", ["metres", "degrees"])
def test_points_of_places_beyond_reach_tell_how_far_the_query_is(frame: str) -> None:
    random, spacing = np.random.default_rng(3), 9.0
    query, stands = stand((3.5, 0.3, 0), 3), [stand((x, 0, 0)) for x in (0.0, spacing, -spacing)]
    shared = sightings(query, stands, random)
    ahead = [float(one.position[0]) for one in stands]
    if frame == "metres":
        poses: list[Pose | None] = [Pose(x=x, y=0, heading=0) for x in ahead]
    else:  # to the east along the equator
        poses = [Pose(latitude=0, longitude=math.degrees(x / EARTH_RADIUS), heading=90) for x in ahead]
    view = RelativeView(rotated(3), np.array([0.4, 0.0, 0]), np.diag([1e-4] * 3 + [1e-2] * 3), 100, "intrinsics")
    alone = estimate_pose(places(poses), [0] * 3, REACH, views=[view])
    found = estimate_pose(places(poses), [0] * 3, REACH, views=[view], sightings=shared)
    assert alone is not None and found is not None and found.source == "intrinsics" and found.places == 3
    if frame == "metres":
        assert [found.pose.x, found.pose.y] == pytest.approx([3.5, 0.3], abs=0.5)
        assert found.pose.heading == pytest.approx(3, abs=1)
    else:
        assert found.pose.longitude is not None and found.pose.latitude is not None
        east, north = (math.radians(angle) * EARTH_RADIUS for angle in (found.pose.longitude, found.pose.latitude))
        assert [east, north] == pytest.approx([3.5, 0.3], abs=0.5)
        assert found.pose.heading == pytest.approx(87, abs=1) and found.pose.z is None
    assert found.spread < alone.spread / 2 and np.linalg.eigvalsh(found.covariance).min() > 0


def test_points_say_nothing_where_the_best_match_has_none_or_places_coincide() -> None:
    random = np.random.default_rng(4)
    query, stands = stand((1, 0.3, 0), 3), [stand((0, 0, 0)), stand((3, 0, 0))]
    shared = sightings(query, stands, random)
    apart: list[Pose | None] = [Pose(x=0, y=0, heading=0), Pose(x=3, y=0, heading=0)]
    together: list[Pose | None] = [Pose(x=0, y=0, heading=0), Pose(x=0.1, y=0, heading=0)]
    for poses, seen in ((apart, [None, shared[1]]), (together, shared), (apart, [shared[0]])):
        found = estimate_pose(places(poses), [0, 0], REACH, sightings=seen)
        assert found is not None and found.source == "places"


def among(query: Stand, errors: PlaceErrors | None, random: np.random.Generator, noise: float = 0.0) -> PoseEstimate:
    """The estimate of a query among three places 9 m apart on one line, whose stated poses have errors."""
    stands = [stand((x, 0, 0)) for x in (0.0, 9.0, -9.0)]
    shared = sightings(query, stands, random)
    poses = [Pose(x=x + random.normal(0, noise), y=random.normal(0, noise), heading=0) for x in (0.0, 9.0, -9.0)]
    view = RelativeView(query.attitude, query.position / 9, np.diag([1e-4] * 3 + [1e-2] * 3), 100, "intrinsics")
    found = estimate_pose(places(list(poses)), [0] * 3, REACH, views=[view], sightings=shared, errors=errors)
    assert found is not None
    return found


@pytest.mark.parametrize("noise", [0.5, 1.0])
def test_errors_of_places_that_are_known_are_covered_and_not_by_absurd_widths(noise: float) -> None:
    random, within, errors, stated = np.random.default_rng(8), [], [], []
    exact = PlaceErrors(np.full(3, noise), np.full(3, np.nan), np.zeros(3))
    for _ in range(30):
        query = stand((random.uniform(-3, 3), random.normal(0, 0.3), 0), random.normal(0, 3))
        found = among(query, exact, random, noise)
        missed = np.array([found.pose.x, found.pose.y]) - query.position[:2]
        within.append(missed @ np.linalg.solve(found.covariance[:2, :2], missed) < 5.99)
        errors.append(np.linalg.norm(missed))
        stated.append(found.spread)
        assert np.linalg.eigvalsh(found.covariance[:2, :2]).min() >= noise**2 - 1e-9, "no surer than its places"
    assert np.mean(within) >= 0.93 and np.median(stated) < 3 * np.median(errors)


def test_a_pose_far_from_all_places_is_widened_or_refused() -> None:
    """A frame is recognized within half the gap of 9 m, or the radius of 5 m: from there on something is wrong."""
    near, beyond, far = (among(stand((2, y, 0)), None, np.random.default_rng(9)) for y in (0.5, 8.0, 14.0))
    assert near.source == "intrinsics" and near.spread < 1
    assert beyond.source == "intrinsics" and beyond.covariance[0, 0] > 2.5**2 and beyond.covariance[1, 1] > 2.5**2
    assert far.places != 3 or far.spread > 5


@pytest.mark.parametrize("kind", ["metres", "degrees"])
def test_headings_that_are_turned_shift_rightly_and_are_not_sure(kind: str) -> None:
    """The camera looks to the north, 90° to the left of what the heading says, and the query is a metre ahead."""
    turned = PlaceErrors(np.full(1, np.nan), np.full(1, np.nan), np.full(1, np.pi / 2))
    heading = 0 if kind == "metres" else 90
    place = Pose(x=0, y=0, heading=heading) if kind == "metres" else Pose(latitude=0, longitude=0, heading=heading)
    view = view_from(Pose(x=0, y=0, heading=90), 0, 1.5, 95, 8)
    found = estimate_pose(places([place]), [0], REACH, views=[view], errors=turned)
    assert found is not None and found.pose.heading is not None
    assert found.pose.heading == pytest.approx(5 if kind == "metres" else 85, abs=1)
    assert math.radians(90) < math.sqrt(found.covariance[5, 5]) < math.radians(90) + TURN
    north = found.pose.y if kind == "metres" else math.radians(found.pose.latitude or 0) * EARTH_RADIUS
    assert north is not None and north > 0.3
