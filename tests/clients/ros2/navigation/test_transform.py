"""The transform from the map to the odometry as a running node sends it."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from tests.clients.ros2.navigation.conftest import begin, go
from tests.clients.ros2.robot import Robot, until

SURE: dict[str, Any] = {"position_limit": 100.0, "heading_limit": 180.0}
"""Limits that never keep the transform back."""
FOUND = 4
"""Frames of the walk after which the robot's place is believed."""


def sent(robot: Robot, topic: str = "map_to_odom", number: int = FOUND) -> list[dict[str, Any]]:
    """The transforms that come with a second of odometry of a robot that stands at a frame, and sees nothing."""
    robot.peer.take(topic)
    for _ in range(10):
        robot.frame += 1
        stamp = robot.odometry(-2.0, 5.0 - number, -90.0, settle=0.0)
    found: list[dict[str, Any]] = []

    def last() -> bool:
        found.extend(robot.peer.take(topic))
        return bool(found) and found[-1]["stamp"] > stamp

    until(last)
    return found


@pytest.mark.thorough
def test_it_is_repeated_ahead_of_odometry_and_changes_by_localizations_alone(moving: Robot) -> None:
    """The odometry's frame is turned by 90° and lies at (5, -2) of the map: x of the map is y of the odometry."""
    robot = moving
    begin(robot, transform_tolerance=0.5, **SURE)
    robot.peer.do("listen", topic="filtered_pose")
    robot.peer.hears(1)
    answer = go(robot, 0, FOUND + 1)
    assert answer["answer"]["motion"] == "odometry" and answer["verdict"] == "recognized"
    pose = until(lambda: robot.peer.take("filtered_pose"))[-1]
    assert pose["x"] == pytest.approx(FOUND, abs=1.5) and 0 < pose["covariance"][0] < 10
    found = sent(robot)
    assert {(one["frame"], one["child"]) for one in found} == {("map", "odom")}
    assert found[-1]["heading"] == pytest.approx(90, abs=10)
    # Map = R(90°) * odometry + t, with the odometry at (-2, 5 - FOUND): t = pose - (FOUND - 5, -2).
    assert (found[-1]["x"], found[-1]["y"]) == pytest.approx((pose["x"] + 5 - FOUND, pose["y"] + 2.0), abs=1.0)
    assert all(before["stamp"] < after["stamp"] for before, after in pairwise(found))
    for one in found:
        assert [one[name] for name in ("x", "y", "heading")] == pytest.approx(
            [found[0][name] for name in ("x", "y", "heading")], abs=1e-4
        )
    newest = robot.BASE + 0.1 * robot.frame
    assert newest < found[-1]["stamp"] <= newest + 0.5 + 1e-6


@pytest.mark.thorough
def test_it_goes_to_tf(moving: Robot) -> None:
    robot = moving
    if not robot.peer.do("knows_tf")["known"]:
        pytest.skip("the message of /tf could not be built: scripts/tf2_messages needs cmake and a C++ compiler")
    begin(robot, **SURE)
    robot.peer.do("listen", topic="/tf")
    go(robot, 0, FOUND + 1)
    found = sent(robot, "/tf")
    assert {(one["frame"], one["child"]) for one in found} == {("map", "odom")}
    assert all(before["stamp"] < after["stamp"] for before, after in pairwise(found))


@pytest.mark.thorough
def test_it_is_kept_back_where_the_robot_is_not_sure(moving: Robot) -> None:
    robot = moving
    begin(robot, position_limit=0.1)
    go(robot, 0, FOUND + 1)
    robot.odometry(-2.0, 5.0 - FOUND, -90.0)
    assert "The transform is not sent" in robot.says("The transform is not sent")["message"]
    assert robot.peer.take("map_to_odom") == []
    assert robot.peer.do("set", values=SURE)["refused"] == []
    assert sent(robot)
    robot.says("The verdict is")


@pytest.mark.thorough
def test_it_ends_with_what_it_rests_on(moving: Robot) -> None:
    """With the belief, at `relocalize`, and with the odometry, when that begins anew."""
    robot = moving
    begin(robot, **SURE)
    go(robot, 0, FOUND + 1)
    assert sent(robot)
    assert robot.peer.do("call", service="relocalize")["success"]
    robot.peer.take("map_to_odom")
    robot.frame += 1
    robot.odometry(-2.0, 5.0 - FOUND, -90.0)
    answer = go(robot, FOUND + 1, FOUND + 2)
    assert answer["answer"]["frames"] == 1
    assert robot.peer.take("map_to_odom") == []
    go(robot, FOUND + 2, FOUND + 5)
    assert sent(robot, number=FOUND + 4)
    for number in range(3):
        robot.frame += 1
        robot.odometry(100.0 + number, 50.0, 0.0)
    robot.peer.take("map_to_odom")
    robot.frame += 1
    robot.odometry(103.0, 50.0, 0.0)
    robot.asked(FOUND + 5)
    assert robot.peer.take("map_to_odom") == []


@pytest.mark.thorough
def test_it_ends_when_no_localization_has_confirmed_it_for_a_while(moving: Robot) -> None:
    """Odometry stands still from then on, as one does that has failed, and goes on to come."""
    robot = moving
    begin(robot, confirmation_limit=3.0, **SURE)
    go(robot, 0, FOUND + 1)
    assert sent(robot), "a second is not too long"
    robot.frame += 30
    robot.odometry(-2.0, 5.0 - FOUND, -90.0)
    robot.says("no localization has confirmed it for 3 s")
    robot.peer.take("map_to_odom")
    for _ in range(10):
        robot.frame += 1
        robot.odometry(-2.0, 5.0 - FOUND, -90.0, settle=0.0)
    robot.says("no localization has confirmed it for 3 s")
    assert robot.peer.take("map_to_odom") == []
