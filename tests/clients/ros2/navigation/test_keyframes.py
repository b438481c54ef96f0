"""A map that the robot makes as it drives."""

from __future__ import annotations

from functools import partial

import pytest

from tests.clients.ros2.navigation.conftest import begin
from tests.clients.ros2.robot import Robot, until
from tests.service.scenes import encoded


@pytest.mark.thorough
def test_keyframes_are_enrolled_as_the_robot_drives(moving: Robot) -> None:
    robot, server = moving, moving.site.server
    begin(robot, role="admin")
    refused = robot.peer.do("switch", service="enrol_keyframes", on=True)
    assert not refused["success"] and "The map has places" in refused["message"]
    assert robot.transition("deactivate") and robot.transition("cleanup")
    begin(robot, map="driven", role="admin", sequence="drive", keyframe_metres=1.9, on_demand=True)
    assert robot.peer.do("call", service="create_map")["success"]
    robot.odometry(0.0, 1.0, 30.0)
    robot.frame += 1
    done = robot.peer.do("switch", service="enrol_keyframes", on=True)
    assert done["success"], done["message"]

    def enrolled() -> list[tuple[float, float, int]]:
        poses = [one["pose"] for one in server.places("driven").values()]
        return [(one["x"], one["y"], round(one["heading"])) for one in poses]

    def has(count: int) -> bool:
        return len(enrolled()) == count

    for number in range(7):
        robot.odometry(float(number), 1.0, 30.0)
        robot.look(encoded(robot.site.frames[number]))
        until(partial(has, number // 2 + 1))
    assert enrolled() == [(0.0, 1.0, 30), (2.0, 1.0, 30), (4.0, 1.0, 30), (6.0, 1.0, 30)]
    assert {one["sequence"] for one in server.places("driven").values()} == {"drive"}
    robot.odometry(6.0, 1.0, 70.0)
    robot.look(encoded(robot.site.frames[6]))
    until(partial(has, 5))
    assert robot.peer.take("answer") == [], "meanwhile it is not localized"
    robot.frame += 1
    for number in range(6):
        robot.odometry(100.0 + 0.1 * number, 1.0, 0.0)
        robot.frame += 1
    robot.odometry(100.6, 1.0, 0.0)
    robot.look(encoded(robot.site.frames[7]))
    assert robot.says("images are enrolled without poses, as the traverse drive~2")["level"] == 1
    until(lambda: len(server.places("driven")) == 6)
    last = list(server.places("driven").values())[-1]
    assert last["sequence"] == "drive~2" and last["pose"] is None
    assert robot.peer.do("switch", service="enrol_keyframes", on=False)["success"]
