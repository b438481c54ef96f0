"""A robot whose odometry contradicts its frames, with a real service: what the node publishes of where it is."""

from __future__ import annotations

import math
from typing import Any

import pytest

from tests.clients.ros2.navigation.conftest import begin
from tests.clients.ros2.robot import Robot, until

TICKS = 10
"""Messages of odometry for each metre of the walk, which takes a second."""
LIMIT = 1.0
"""Metres that the position may have as a standard deviation while the transform is sent."""
FAULTS = {
    "frozen from the start": (0, "frozen"),
    "frozen from the middle": (6, "frozen"),
    "turned by 180 degrees": (0, "turned"),
}


def reported(metre: float, first: int, kind: str) -> tuple[float, float, float]:
    """The pose by odometry after so many metres, which has a fault from a metre on; see ``conftest.go``."""
    if kind == "frozen":
        return -2.0, 5.0 - min(metre, float(first)), -90.0
    return -2.0, 5.0 - metre, 90.0


@pytest.mark.thorough
@pytest.mark.parametrize("fault", FAULTS)
def test_the_pose_and_the_transform_are_as_right_as_they_say(moving: Robot, fault: str) -> None:
    """The robot is at so many metres along x as seconds have gone."""
    robot, (first, kind) = moving, FAULTS[fault]
    begin(robot, position_limit=LIMIT, transform_tolerance=0.0)
    robot.peer.do("listen", topic="filtered_pose")
    robot.peer.hears(1)
    answer: dict[str, Any] = {}
    count = len(robot.site.frames)
    for number in range(count):
        for tick in range(1 - TICKS if number else 0, 0):
            robot.odometry(*reported(number + tick / TICKS, first, kind), settle=0.0)
            robot.frame += 1
        robot.odometry(*reported(number, first, kind))
        answer = robot.asked(number)
    poses: list[dict[str, Any]] = []

    def all_came() -> bool:
        poses.extend(robot.peer.take("filtered_pose"))
        return bool(poses) and poses[-1]["stamp"] >= answer["stamp"] - 1e-3

    until(all_came)
    assert len(poses) >= count - 3, "it is known after three frames"
    for one in poses:
        error = math.hypot(one["x"] - (one["stamp"] - robot.BASE), one["y"])
        assert error <= 3 * math.sqrt(max(one["covariance"][0], one["covariance"][7])), one
    assert error < 1, "at the end the frames are followed"
    for one in robot.peer.take("map_to_odom"):
        metre, turned = one["stamp"] - robot.BASE, math.radians(one["heading"])
        x, y, _ = reported(metre, first, kind)
        at = one["x"] + math.cos(turned) * x - math.sin(turned) * y
        beside = one["y"] + math.sin(turned) * x + math.cos(turned) * y
        assert math.hypot(at - metre, beside) <= 3 * LIMIT, one
    status = robot.says("Odometry contradicts the frames")
    assert status["level"] == 1 and f"({kind})" in status["message"]
    assert status["values"]["motion"] == "contradicted" and status["values"]["contradiction"] == kind
