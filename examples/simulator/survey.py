"""The drive from which the map is made: a bag of the camera and of where the robot really was."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from examples.simulator.camera import Camera
from examples.simulator.driver import Driver
from examples.simulator.world import LENGTH, WIDTH, Hall, Robot
from placerec_ros.planar import Planar, quaternion

SECOND = 1_000_000_000  # nanoseconds
BEGIN = 1_767_607_200 * SECOND
STEPS = 10
"""Poses a second; there is a frame a second."""
TYPES = get_typestore(Stores.ROS2_KILTED)
AROUND = [(0.0, 0.0), (LENGTH, 0.0), (LENGTH, WIDTH), (0.0, WIDTH), (0.0, 0.0), (LENGTH / 4, 0.0)]
"""A round of the corridor, and a little of the next one."""


def drive(hall: Hall) -> Iterator[tuple[int, Planar]]:
    """Where the robot is, with the nanosecond of each pose."""
    driver = Driver(AROUND)
    robot = Robot(hall, Planar(0.0, 0.0, 0.0), Planar(0.0, 0.0, 0.0))
    stamp = BEGIN
    while not driver.arrived:
        yield stamp, robot.true
        command = driver.command(robot.true)
        robot.step(command.speed, command.turn, 1 / STEPS)
        stamp += SECOND // STEPS


def _header(stamp: int, frame: str) -> Any:
    time = TYPES.types["builtin_interfaces/msg/Time"](sec=stamp // SECOND, nanosec=stamp % SECOND)
    return TYPES.types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def odometry(stamp: int, robot: Planar) -> Any:
    """A message whose pose is true, as that of a system that has surveyed the hall."""
    types = TYPES.types
    zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    x, y, z, w = quaternion(robot.yaw)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=robot.x, y=robot.y, z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
    )
    return types["nav_msgs/msg/Odometry"](
        header=_header(stamp, "map"),
        child_frame_id="base_link",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](
            twist=types["geometry_msgs/msg/Twist"](linear=zero, angular=zero), covariance=np.zeros(36)
        ),
    )


def image(stamp: int, pixels: Any) -> Any:
    """A picture of the camera."""
    height, width = pixels.shape[:2]
    return TYPES.types["sensor_msgs/msg/Image"](
        header=_header(stamp, "camera_optical_frame"),
        height=height,
        width=width,
        encoding="bgr8",
        is_bigendian=0,
        step=3 * width,
        data=pixels.ravel(),
    )


def record(path: Path) -> int:
    """Write the bag; how many frames it has.

    Raises:
        FileExistsError: there is something already.
    """
    if path.exists():
        raise FileExistsError(f"{path} is there already.")
    hall = Hall()
    camera, frames = Camera(hall), 0
    with Writer(path, version=9) as writer:
        topics = {"/odom": "nav_msgs/msg/Odometry", "/camera/image_raw": "sensor_msgs/msg/Image"}
        connections = {topic: writer.add_connection(topic, kind, typestore=TYPES) for topic, kind in topics.items()}
        for number, (stamp, pose) in enumerate(drive(hall)):
            said = {"/odom": odometry(stamp, pose)}
            if number % STEPS == 0:
                said["/camera/image_raw"] = image(stamp, camera.look(pose))
                frames += 1
            for topic, message in said.items():
                writer.write(connections[topic], stamp, TYPES.serialize_cdr(message, topics[topic]))
    return frames
