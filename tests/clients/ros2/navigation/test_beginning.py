"""Where a run begins: poses that others give or take, images on demand, and the camera's place on the robot."""

from __future__ import annotations

from typing import Any

import pytest

from tests.clients.ros2.navigation.conftest import begin, go
from tests.clients.ros2.navigation.test_transform import FOUND, SURE, sent
from tests.clients.ros2.robot import Robot, until


@pytest.mark.thorough
def test_the_pose_is_given_to_others_once(moving: Robot) -> None:
    robot = moving
    robot.peer.do("listen", topic="/initialpose")
    begin(robot, send_initial_pose=True, **SURE)
    until(lambda: robot.peer.do("listeners", topic="/initialpose")["publishers"])
    go(robot, 0, FOUND + 2)
    (pose,) = until(lambda: robot.peer.take("/initialpose"))
    assert pose["frame"] == "map" and pose["x"] <= FOUND
    assert pose["covariance"][0] > 0 and pose["covariance"][35] > 0
    assert robot.asked(FOUND + 2)["answer"]["frames"] == FOUND + 3, "its own pose is no news to it"
    assert robot.peer.take("/initialpose") == []
    assert robot.peer.do("call", service="relocalize")["success"]
    go(robot, FOUND + 3, FOUND + 7)
    assert len(until(lambda: robot.peer.take("/initialpose"))) == 1


def give(robot: Robot, **fields: Any) -> None:
    """Publish a pose as RViz does."""
    robot.peer.do("advertise", topic="/initialpose", kind="PoseWithCovarianceStamped", reliable=True)
    robot.connected("/initialpose")
    robot.peer.do("publish", topic="/initialpose", kind="PoseWithCovarianceStamped", **fields)


@pytest.mark.thorough
def test_a_pose_that_somebody_gives_is_believed_at_once(moving: Robot) -> None:
    robot = moving
    begin(robot)
    robot.odometry(-2.0, 5.0, -90.0)
    give(robot, frame_id="odom", x=1.0, y=2.0, heading=0.0)
    robot.says("An initial pose is in the frame 'odom'")
    give(robot, x=30.0, y=7.0, heading=0.0)
    until(lambda: "believed to be at x 30.00" in robot.log())
    found = sent(robot, number=0)[-1]
    assert found["heading"] == pytest.approx(90)
    assert (found["x"], found["y"]) == pytest.approx((35.0, 9.0)), "the odometry says (-2, 5), turned by 90°"
    assert robot.peer.do("set", values={"take_initial_pose": False})["refused"] == []
    give(robot, x=0.0, y=0.0, heading=0.0)
    assert sent(robot, number=0)[-1]["x"] == pytest.approx(35.0)


@pytest.mark.thorough
def test_images_are_sent_on_demand_alone(moving: Robot) -> None:
    robot = moving
    begin(robot, on_demand=True, **SURE)
    go(robot, 0, FOUND - 1)

    def unwanted(before: int = 0) -> bool:
        robot.look(number=FOUND)
        return int(robot.says("")["values"].get("frames not wanted", 0)) > before

    until(unwanted)
    robot.peer.take("answer")
    count = int(robot.says("")["values"]["frames not wanted"])
    until(lambda: unwanted(count))
    assert robot.peer.take("answer") == []
    assert sent(robot, number=FOUND - 2), "the transform goes on"
    assert robot.peer.do("call", service="relocalize")["success"]
    assert go(robot, FOUND, FOUND + 1)["answer"]["frames"] == 1


@pytest.mark.thorough
def test_images_above_the_rate_are_left_out(moving: Robot) -> None:
    robot = moving
    begin(robot, rate_limit=5.0)
    stamps = []
    for number in range(8):
        stamps.append(robot.look(number=number))
        robot.peer.do("sleep", seconds=0.05)
    answers = robot.answers(4)
    assert [round(one["stamp"], 3) for one in answers] == [round(stamp, 3) for stamp in stamps[::2]]
    assert robot.peer.do("set", values={"rate_limit": 0.0})["refused"] == []
    robot.asked(8)
    robot.asked(9)


@pytest.mark.thorough
def test_images_come_by_image_transport(robot: Robot) -> None:
    robot.peer.do("advertise", topic="/image/compressed", kind="CompressedImage")
    robot.begin(image_transport="compressed")
    robot.connected("/image/compressed")
    path = str(robot.site.folder / "again-00.jpg")
    robot.peer.do("publish", topic="/image/compressed", kind="CompressedImage", stamp=robot.BASE, file=path)
    assert robot.answers()[0]["place"] == "p00"


@pytest.mark.thorough
def test_the_camera_is_found_on_the_robot(moving: Robot) -> None:
    """It stands 0.5 m ahead of the base and looks to the left: the robot's heading is 90° less than the places'."""
    robot = moving
    if not robot.peer.do("knows_tf")["known"]:
        pytest.skip("the message of /tf_static could not be built: scripts/tf2_messages needs cmake and a compiler")
    robot.peer.do("advertise", topic="/tf_static", kind="TFMessage", durable=True)
    fields = {
        "parent": "base_link",
        "child": "camera",
        "moved": [0.5, 0.0, 1.0],
        "turned": [0.0, 0.0, 0.5**0.5, 0.5**0.5],
    }
    robot.peer.do("publish", topic="/tf_static", kind="TFMessage", **fields)
    begin(robot, poses_of="camera", odom_frame="robot1/odom", **SURE)
    robot.connected("/tf_static")
    robot.odometry(-3.0 - FOUND, 5.0, -90.0)
    until(lambda: (robot.look(number=0), robot.says("")["values"].get("camera on the robot"))[1])
    robot.answers_settled()
    robot.peer.take("pose")
    for number in range(1, FOUND + 2):
        robot.odometry(number - 3.0 - FOUND, 5.0, -90.0)
        answer = robot.asked(number)
    pose = until(lambda: robot.peer.take("pose"))[-1]
    camera = answer["answer"]["single"]["pose"]
    assert (pose["heading"] - camera["heading"] + 270) % 360 == pytest.approx(180, abs=0.1) or answer[
        "pose_source"
    ] == "belief"
    assert pose["heading"] == pytest.approx(270, abs=20)
    assert pose["y"] == pytest.approx(0.5, abs=0.4), "the base is behind the camera, which is to the left of its front"
    assert sent(robot, number=0)[-1]["child"] == "robot1/odom"
