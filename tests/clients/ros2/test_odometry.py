"""Odometry between frames, and the transform from the map to the odometry."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core import clocks
from core.belief import OdometryPose
from placerec_ros.odometry import CLOCK_JUMP, MOST_POSES, NANOSECONDS, Odometer
from placerec_ros.planar import Planar, map_to_odom, quaternion, wrapped, yaw_of
from tests.clients.ros2.ros_messages import odometry

poses = st.builds(Planar, *[st.floats(-50, 50)] * 2, st.floats(-3.1, 3.1))


def at(odometer: Odometer, seconds: float) -> Planar | None:
    return odometer.at(round(seconds * NANOSECONDS))


def test_a_pose_is_interpolated_across_the_half_turn() -> None:
    odometer = Odometer()
    odometer.add(odometry(10.0, 0.0, 0.0, math.radians(170)))
    odometer.add(odometry(10.4, 4.0, 2.0, math.radians(-170)))
    found = at(odometer, 10.1)
    assert found is not None
    assert (found.x, found.y) == pytest.approx((1.0, 0.5))
    assert math.degrees(found.yaw) == pytest.approx(175)
    assert odometer.frame == "odom"
    assert odometer.child == "base_link"


def test_no_pose_is_made_up_where_odometry_is_missing() -> None:
    odometer = Odometer()
    assert at(odometer, 10.0) is None
    odometer.add(odometry(10.0, 0.0, 0.0))
    odometer.add(odometry(12.0, 1.0, 0.0))
    assert at(odometer, 9.9) is None, "before the first"
    assert at(odometer, 11.0) is None, "in a gap"
    assert at(odometer, 12.05) == at(odometer, 12.0), "a little after the last"
    assert at(odometer, 12.2) is None, "long after the last"


def test_node_and_service_call_the_same_a_jump_of_a_clock() -> None:
    assert CLOCK_JUMP == clocks.CLOCK_JUMP


def test_messages_out_of_order_are_sorted_and_a_clock_that_is_set_back_begins_anew() -> None:
    odometer = Odometer()
    for stamp in (10.0, 10.4, 10.2):
        odometer.add(odometry(stamp, stamp, 0.0))
    found = at(odometer, 10.3)
    assert found is not None and found.x == pytest.approx(10.3)
    odometer.add(odometry(5.0, 5.0, 0.0))
    assert at(odometer, 10.2) is None
    odometer.add(odometry(5.1, 5.0, 0.0, frame_id="map"))
    assert at(odometer, 5.0) is None, "another frame is another odometry"


def test_stored_readings_are_bounded() -> None:
    odometer = Odometer()
    for number in range(3 * MOST_POSES // 2):
        odometer.add(odometry(100 + number * 1e-4, 0.0, 0.0))
    assert len(odometer._poses) <= MOST_POSES
    for number in range(3000):
        odometer.add(odometry(200 + number * 0.02, 0.0, 0.0))
    assert len(odometer._poses) < 700, "ten seconds and a little"


@pytest.mark.parametrize("broken", [(math.nan, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, math.inf)])
def test_a_pose_that_is_none_is_refused(broken: tuple[float, float, float]) -> None:
    message = odometry(1.0, broken[0], broken[1])
    message.pose.pose.orientation.w = broken[2]
    odometer = Odometer()
    with pytest.raises(ValueError, match=r"finite|rotation"):
        odometer.add(message)
    assert odometer.frame == ""


def told(odometer: Odometer, seconds: float, camera_yaw: float = 0.0) -> OdometryPose:
    """What the service makes of what the node tells."""
    found = odometer.odometry(round(seconds * NANOSECONDS), camera_yaw)
    assert found is not None
    covariance = None if found.covariance is None else tuple(found.covariance)
    return OdometryPose(found.x, found.y, math.radians(found.heading), covariance, found.origin)


def test_the_motion_is_that_of_the_robot_or_of_a_camera_that_looks_aside() -> None:
    odometer = Odometer()
    odometer.add(odometry(10.0, 3.0, 1.0, math.radians(90)))
    odometer.add(odometry(10.4, 3.0, 3.0, math.radians(120)))
    for camera, forward, left in ((0.0, 2.0, 0.0), (math.radians(90), 0.0, -2.0)):
        moved = told(odometer, 10.4, camera).since(told(odometer, 10.0, camera))
        assert (moved.forward, moved.left, math.degrees(moved.turn)) == pytest.approx((forward, left, 30.0))
    assert odometer.odometry(12 * NANOSECONDS) is None


def test_the_covariance_is_that_of_the_plane() -> None:
    odometer, grown = Odometer(), np.zeros((6, 6))
    grown[np.ix_((0, 1, 5), (0, 1, 5))] = [[0.4, 0.02, 0.0], [0.02, 0.2, 0.1], [0.0, 0.1, 0.3]]
    odometer.add(odometry(10.0, 0.0, 0.0))
    odometer.add(odometry(10.4, 1.0, 0.0, covariance=grown.ravel().tolist()))
    found = told(odometer, 10.2).covariance
    assert found is not None
    np.testing.assert_allclose(np.reshape(found, (3, 3)), grown[np.ix_((0, 1, 5), (0, 1, 5))] / 2)
    for number, broken in enumerate((math.nan, -1.0, math.inf)):
        odometer.add(odometry(11.0 + number, 1.0, 0.0, covariance=[broken] * 36))
        assert told(odometer, 11.0 + number).covariance is None


def test_odometry_that_begins_anew_has_another_origin() -> None:
    odometer = Odometer()
    origins = []
    for stamp, x, yaw, frame in (
        (10.0, 30.0, 1.0, "odom"),
        (10.1, 30.2, 1.0, "odom"),
        (13.0, 0.0, 0.0, "odom"),  # its node was restarted
        (13.1, 0.1, 0.0, "odom"),
        (13.2, 60.0, 0.0, "odom"),  # it was set
        (13.3, 60.5, 0.0, "odom"),
        (13.4, 61.0, 0.0, "visual"),
        (5.0, 61.0, 0.0, "visual"),  # the clock was set back
        (5.1, 0.5, 0.0, "visual"),
        (5.2, 0.0, 0.0, "visual"),  # it drives back to where it began
    ):
        odometer.add(odometry(stamp, x, 0.0, yaw, frame))
        origins.append(told(odometer, stamp).origin)
    changes = [one != other for one, other in pairwise(origins)]
    assert changes == [False, True, False, True, False, True, True, True, False]
    assert at(odometer, 5.15) is not None and at(odometer, 5.05) is None, "nothing is read across a beginning"


def origins(odometer: Odometer, messages: Iterable[Any]) -> int:
    """With how many origins messages are told."""
    found = set()
    for message in messages:
        odometer.add(message)
        found.add(told(odometer, message.header.stamp.sec + message.header.stamp.nanosec * 1e-9).origin)
    return len(found)


@pytest.mark.parametrize("speed", [0.0, 1.5], ids=["twist is not told", "twist is told"])
@pytest.mark.parametrize("yaw", [0.0, 1.0], ids=["heading of wheels", "heading of an IMU"])
def test_a_restart_is_seen_whatever_the_heading(speed: float, yaw: float) -> None:
    before = [odometry(10 + number * 0.1, 29.9 + 0.15 * number, 0.0, yaw, speed=speed) for number in range(3)]
    assert origins(Odometer(), [*before, odometry(13.2, 0.0, 0.0, yaw), odometry(13.3, 0.1, 0.0, yaw)]) == 2


@pytest.mark.parametrize("speed", [0.0, 1.5], ids=["twist is not told", "twist is told"])
@pytest.mark.parametrize("seconds", [0.02, 1.0, 3.0])
def test_a_robot_that_drives_where_it_can_keeps_its_origin(speed: float, seconds: float) -> None:
    """Over its own origin, slow as its odometry may be, after a stop, and over a gap."""
    drive = [odometry(10 + number * seconds, 1.5 * seconds * (number - 4), 0.0, speed=speed) for number in range(9)]
    assert origins(Odometer(), drive) == 1
    stop = [odometry(10 + number * seconds, 5.0, 0.0) for number in range(3)]
    start = [odometry(10 + number * seconds, 5 + 1.5 * seconds * (number - 2), 0.0) for number in range(3, 6)]
    assert origins(Odometer(), stop + start) == 1
    assert origins(Odometer(), drive[:4] + drive[8:]) == 1, "messages were lost"


def test_what_a_twist_tells_beyond_numbers_is_ignored() -> None:
    broken = [odometry(10.0 + number, 1.0, 0.0, speed=speed) for number, speed in enumerate((math.nan, math.inf, 0.0))]
    assert origins(Odometer(), [*broken, odometry(15.0, 40.0, 0.0)]) == 2


def test_the_limit_of_the_speed_tells_how_far_a_robot_can_have_gone() -> None:
    messages = [odometry(10.0, 30.0, 0.0), odometry(13.0, 0.0, 0.0, 1.0)]
    assert origins(Odometer(), messages) == 1, "nobody knows how fast it is"
    assert origins(Odometer(speed_limit=2.0), messages) == 2


@given(poses, poses)
def test_the_map_to_odom_transform_takes_odometry_to_the_map(in_map: Planar, in_odom: Planar) -> None:
    found = map_to_odom(in_map, in_odom).then(in_odom)
    assert (found.x, found.y) == pytest.approx((in_map.x, in_map.y), abs=1e-9)
    assert abs(wrapped(found.yaw - in_map.yaw)) < 1e-9


@given(poses, poses)
def test_transforms_are_those_of_matrices(first: Planar, second: Planar) -> None:
    def matrix(one: Planar) -> np.ndarray:
        cos, sin = math.cos(one.yaw), math.sin(one.yaw)
        return np.array([[cos, -sin, one.x], [sin, cos, one.y], [0, 0, 1]])

    np.testing.assert_allclose(matrix(first.then(second)), matrix(first) @ matrix(second), atol=1e-9)
    np.testing.assert_allclose(matrix(first.inverse()) @ matrix(first), np.eye(3), atol=1e-9)


@given(st.floats(-3.14, 3.14))
def test_quaternions_keep_the_heading(yaw: float) -> None:
    assert yaw_of(*quaternion(yaw)) == pytest.approx(yaw)
