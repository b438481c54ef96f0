"""A robot that drives the walk with odometry."""

from __future__ import annotations

from typing import Any

import pytest

from tests.clients.ros2.robot import Robot


@pytest.fixture
def moving(robot: Robot) -> Robot:
    """A robot with a camera and odometry; begin() is called by the test."""
    robot.peer.do("advertise", topic="/image", kind="CompressedImage")
    robot.peer.do("advertise", topic="/odom", kind="Odometry", reliable=True)
    return robot


def begin(robot: Robot, **parameters: Any) -> None:
    """Activate the node with parameters, and wait until it hears the robot."""
    robot.begin(**parameters)
    robot.connected()
    robot.connected("/odom")


def go(robot: Robot, start: int, stop: int) -> dict[str, Any]:
    """Let the robot drive and see; its odometry is turned by 90°, and begins at (5, -2) of the map."""
    answer: dict[str, Any] = {}
    for number in range(start, stop):
        robot.odometry(-2.0, 5.0 - number, -90.0)
        answer = robot.asked(number)
    return answer
