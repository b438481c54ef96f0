"""The filter of localizations and odometry, on made-up ones."""

from __future__ import annotations

import math

import numpy as np
import pytest

from placerec_ros.fusion import BEGINS, CHANGES, Fix, Fusion
from placerec_ros.planar import Planar, wrapped
from placerec_ros.pose import UNKNOWN_ANGLE, PoseEstimate
from placerec_ros.track import COMMON, Track

STATED = np.diag([1.0, 1.0, math.radians(20) ** 2])


def found(robot: Planar, deviation: float = 1.0, heading: float = math.radians(20)) -> PoseEstimate:
    covariance = np.diag([deviation**2, deviation**2, 1e6, UNKNOWN_ANGLE, UNKNOWN_ANGLE, heading**2])
    return PoseEstimate(robot, tuple(covariance.ravel().tolist()), "frame")


def driven(fusion: Fusion, start: int, stop: int, shift: float = 0.0) -> Fix | None:
    """A metre a frame along x, with odometry that begins at (5, 5) and looks along y; the map is off by ``shift``."""
    fix = None
    for number in range(start, stop):
        odom = Planar(5.0, 5.0 + number, math.pi / 2)
        fix = fusion.add(odom, "start", found(Planar(number, shift, 0.0)), float(number))
    return fix


def test_a_robot_that_stands_learns_little_from_the_same_sight() -> None:
    track = Track(Planar(0.0, 0.0, 0.0), STATED)
    for _ in range(1000):
        track.move(Planar(0.0, 0.0, 0.0), 1.0)
        track.correct(Planar(0.0, 0.0, 0.0), STATED)
    assert np.all(np.diag(track.covariance) >= 0.95 * COMMON * np.diag(STATED))
    assert np.all(np.linalg.eigvalsh(track.covariance) > 0)


def test_driving_tells_the_heading() -> None:
    track = Track(Planar(0.0, 0.0, math.radians(15)), STATED)
    assert math.degrees(math.sqrt(track.covariance[2, 2])) > 20
    for number in range(1, 41):
        track.move(Planar(1.0, 0.0, 0.0), 1.0)
        track.correct(Planar(float(number), 0.0, math.radians(15)), STATED)  # its heading is wrong all the way
    assert math.degrees(math.sqrt(track.covariance[2, 2])) < 5
    assert abs(math.degrees(track.robot.yaw)) < 3 * math.degrees(math.sqrt(track.covariance[2, 2]))


def test_odometry_that_says_too_much_is_known_to_after_a_while() -> None:
    track = Track(Planar(0.0, 0.0, 0.0), STATED)
    for number in range(1, 301):
        track.move(Planar(1.05, 0.0, 0.0), 1.0)
        track.correct(Planar(float(number), 0.0, 0.0), STATED)
    before = track.robot
    track.move(Planar(105.0, 0.0, 0.0), 100.0)
    assert track.robot.x - before.x == pytest.approx(100, abs=1.5)


def test_a_way_without_localizations_makes_it_less_sure() -> None:
    fusion = Fusion()
    fix = driven(fusion, 0, 20)
    assert fix is not None
    position, heading = fix.deviations
    later = fix.at(Planar(5.0, 74.0, math.pi / 2), 74.0)
    assert later.deviations[0] > position + 1.0 and later.deviations[1] > heading
    assert fix.deviations == (position, heading), "a fix does not change"


def test_it_is_believed_when_enough_localizations_agree() -> None:
    fusion = Fusion()
    assert driven(fusion, 0, BEGINS - 1) is None
    fix = driven(fusion, BEGINS - 1, BEGINS)
    assert fix is not None
    placed = fix.correction.then(fix.odom)
    assert (placed.x, placed.y, wrapped(placed.yaw)) == pytest.approx((BEGINS - 1, 0.0, 0.0), abs=0.2)
    scattered = Fusion()
    for number in range(10):
        far = found(Planar(50.0 * (number % 3), 20.0 * number, 0.0))
        assert scattered.add(Planar(float(number), 0.0, 0.0), "start", far, float(number)) is None


def test_a_single_wrong_localization_moves_nothing() -> None:
    fusion = Fusion()
    fix = driven(fusion, 0, 20)
    assert fix is not None
    after = fusion.add(fix.odom, "start", found(Planar(60.0, 40.0, 2.0), 0.1, 0.02), fix.moment)
    assert after is not None and after.correction == fix.correction
    assert fusion.refused == 1


def test_a_robot_that_was_carried_off_is_found_again() -> None:
    fusion = Fusion()
    driven(fusion, 0, 20)
    fix = driven(fusion, 20, 20 + CHANGES, shift=40.0)
    assert fix is not None and abs(fix.track.robot.y) < 5, "not yet: it could be one and the same error"
    fix = driven(fusion, 20 + CHANGES, 45, shift=40.0)
    assert fix is not None and fix.track.robot.y == pytest.approx(40, abs=1)
    assert fusion.replaced == 1


def test_a_robot_that_stands_is_not_carried_off_by_what_it_sees() -> None:
    fusion = Fusion()
    fix = driven(fusion, 0, 20)
    assert fix is not None
    for _ in range(100):
        fix = fusion.add(fix.odom, "start", found(Planar(60.0, 40.0, 0.0)), fix.moment + 1)
        assert fix is not None and fix.track.robot.x < 25
    assert fusion.replaced == 0


def test_odometry_that_begins_anew_is_another_drive() -> None:
    fusion = Fusion()
    assert driven(fusion, 0, 20) is not None
    assert fusion.add(Planar(0.0, 0.0, 0.0), "again", None, 20.0) is None


def test_a_pose_that_is_given_is_as_sure_as_it_says_and_gives_way_to_what_is_seen() -> None:
    fusion = Fusion()
    fix = fusion.place(
        Planar(0.0, 1.0, 0.0), np.diag([0.25, 0.25, math.radians(15) ** 2]), Planar(5.0, 5.0, 0.0), "start", 0.0
    )
    assert fix.deviations == pytest.approx((0.5, math.radians(15)), rel=0.03)
    later = driven(fusion, 0, 1)
    assert later is not None and abs(later.track.robot.y) < 1.0
    for number in range(1, 101):
        odom = Planar(5.0, 5.0 + number, math.pi / 2)
        later = fusion.add(odom, "start", found(Planar(number, 0.0, 0.0)), float(number))
    assert later is not None and later.track.robot.y == pytest.approx(0, abs=0.4)


def test_places_without_headings_begin_nothing_and_pull_no_heading() -> None:
    unknown = math.sqrt(UNKNOWN_ANGLE)
    fusion = Fusion()
    for number in range(10):
        assert (
            fusion.add(
                Planar(float(number), 0.0, 0.0), "start", found(Planar(number, 0.0, 0.0), 1.0, unknown), float(number)
            )
            is None
        )
    fusion = Fusion()
    fix = driven(fusion, 0, 20)
    assert fix is not None
    yaw = fix.track.robot.yaw
    fix = fusion.add(fix.odom, "start", found(Planar(19.0, 0.0, 3.0), 1.0, unknown), fix.moment)
    assert fix is not None and fix.track.robot.yaw == pytest.approx(yaw, abs=1e-3)
    assert fusion.refused == 0


def test_odometry_that_the_session_contradicts_is_not_followed() -> None:
    """The localizations alone, of which there are none any more, go on; it is soon not known where the robot is."""
    fusions = Fusion(), Fusion()
    for fusion in fusions:
        assert driven(fusion, 0, 20) is not None
    trusted, doubted = (
        fusion.add(Planar(5.0, 25.0, math.pi / 2), "start", None, 22.0, contradicted)
        for fusion, contradicted in zip(fusions, (False, True), strict=True)
    )
    assert trusted is not None and doubted is not None
    assert trusted.track.doubt < 0.1 < 0.8 < doubted.track.doubt
    assert doubted.deviations[0] > 2 * trusted.deviations[0]
    assert doubted.unconfirmed == trusted.unconfirmed == 3.0


def test_the_ways_that_do_not_agree_are_told_in_words() -> None:
    fusion = Fusion()
    for number in range(20):
        fix = fusion.add(Planar(5.0, 5.0, 0.0), "start", found(Planar(number, 0.0, 0.0)), float(number))
    assert fix is not None and fix.track.doubt > 0.5
    assert fusion.way == (
        "odometry went 0.0 m at 0° from its front and turned by 0°, "
        "the localizations 9.0 m at 0° from its front and turned by 0°"
    )
