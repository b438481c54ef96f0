"""The robot and its driver as nodes of ROS 2, beside the node placerec that tells them where they are.

Time is the robot's own: it goes on when all have done their part, however long that takes. A step lasts a tenth of a
second. In each the robot says where its odometry believes it to be, waits for the transform of the node if one is due,
and for the driver's command. Every few steps it takes a picture first, and waits for the node's answer.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String

from examples.simulator.camera import COLUMNS, FOCAL, MOUNT, ROWS, Camera
from examples.simulator.driver import Command, Driver
from examples.simulator.run import Frame, Run
from examples.simulator.world import Array, Robot
from placerec_ros.planar import Planar, quaternion, yaw_of

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the wheels of ROS lack it; scripts/tf2_messages builds it
    TFMessage = None

SECOND = 1_000_000_000  # nanoseconds
BEGIN = 1_767_693_600 * SECOND
STEP = SECOND // 10
STEPS_PER_FRAME = 8
PATIENCE = 120.0
"""Seconds after which somebody who does not answer is given up."""
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
"""From a body frame, x ahead, to an optical one, z ahead (REP 103)."""
POSITION, HEADING = 3.0, math.radians(20)
"""The limits of the node's parameters position_limit and heading_limit, within which it sends the transform."""
TOLERANCE = SECOND // 2
"""By which the stamp of the transform lies ahead, as the node's parameter transform_tolerance says."""
SOON = 1.0
"""Seconds after which the first picture is taken once more: nodes that have just met may miss a message."""


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec) * SECOND + int(message.header.stamp.nanosec)


def planar_of(position: Any, turned: Any) -> Planar:
    return Planar(position.x, position.y, yaw_of(turned.x, turned.y, turned.z, turned.w))


def transform(parent: str, child: str, stamp: int, pose: Planar, turned: tuple[float, ...] | None = None) -> Any:
    """A message of where a frame is in another."""
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id, message.header.stamp = parent, time_of(stamp)
    moved, rotation = message.transform.translation, message.transform.rotation
    moved.x, moved.y, moved.z = pose.x, pose.y, pose.z
    rotation.x, rotation.y, rotation.z, rotation.w = turned or quaternion(pose.yaw)
    return message


def time_of(stamp: int) -> Time:
    return Time(sec=stamp // SECOND, nanosec=stamp % SECOND)


class DriverNode:
    """The driver: it hears odometry and the transform from the map to it, and says how to drive."""

    def __init__(self, driver: Driver) -> None:
        self.node: Any = Node("driver")
        self.driver = driver
        self.correction: tuple[int, Planar] | None = None
        """The last transform from the map to the odometry, with its stamp."""
        self.commands = self.node.create_publisher(TwistStamped, "cmd_vel", 10)
        self.node.create_subscription(Odometry, "odom", self._drive, 100)
        if TFMessage is not None:
            self.node.create_subscription(TFMessage, "/tf", self._take_all, 100)
        else:
            self.node.create_subscription(TransformStamped, "/placerec/map_to_odom", self._take, 100)

    def _take_all(self, message: Any) -> None:
        for one in message.transforms:
            self._take(one)

    def _take(self, message: Any) -> None:
        if message.header.frame_id == "map" and message.child_frame_id == "odom":
            moved = message.transform.translation
            self.correction = stamp_of(message), planar_of(moved, message.transform.rotation)

    def _drive(self, message: Any) -> None:
        odom = planar_of(message.pose.pose.position, message.pose.pose.orientation)
        robot = None if self.correction is None else self.correction[1].then(odom)
        command = self.driver.command(robot)
        said = TwistStamped()
        said.header.stamp, said.header.frame_id = message.header.stamp, "base_link"
        said.twist.linear.x, said.twist.angular.z = command.speed, command.turn
        self.commands.publish(said)


class RobotNode:
    """The robot: its sensors as publishers, its wheels as a subscription."""

    def __init__(self, robot: Robot, camera: Camera) -> None:
        self.robot, self.camera = robot, camera
        self.node: Any = Node("robot")
        self.command: tuple[int, Command] | None = None
        self.answers: dict[int, dict[str, Any]] = {}
        self.odometry = self.node.create_publisher(Odometry, "odom", 100)
        self.pictures = self.node.create_publisher(Image, "camera/image_raw", 5)
        self.infos = self.node.create_publisher(CameraInfo, "camera/camera_info", 5)
        self.tf: Any = None
        if TFMessage is not None:
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.tf = self.node.create_publisher(TFMessage, "/tf", 100)
            self.tf_static = self.node.create_publisher(TFMessage, "/tf_static", latched)
            placed = transform("base_link", "camera_optical_frame", BEGIN, MOUNT, OPTICAL)
            self.tf_static.publish(TFMessage(transforms=[placed]))
        self.node.create_subscription(TwistStamped, "cmd_vel", self._take, 10)
        self.node.create_subscription(String, "/placerec/answer", self._hear, 100)

    def _take(self, message: Any) -> None:
        self.command = stamp_of(message), Command(message.twist.linear.x, message.twist.angular.z)

    def _hear(self, message: Any) -> None:
        answer = json.loads(message.data)
        self.answers[round(answer["stamp"] * SECOND / STEP)] = answer

    def say(self, stamp: int) -> None:
        """Publish the odometry of a moment."""
        odom = self.robot.odom
        message = Odometry(child_frame_id="base_link")
        message.header.stamp, message.header.frame_id = time_of(stamp), "odom"
        pose = message.pose.pose
        pose.position.x, pose.position.y = odom.x, odom.y
        pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = quaternion(odom.yaw)
        self.odometry.publish(message)
        if self.tf is not None:
            self.tf.publish(TFMessage(transforms=[transform("odom", "base_link", stamp, odom)]))

    def show(self, stamp: int) -> None:
        """Publish what the camera sees, and its intrinsics."""
        info = CameraInfo(width=COLUMNS, height=ROWS, distortion_model="plumb_bob", d=[0.0] * 5)
        info.header.stamp, info.header.frame_id = time_of(stamp), "camera_optical_frame"
        x, y = (COLUMNS - 1) / 2, (ROWS - 1) / 2  # the centre of the first pixel is at (0, 0)
        info.k = [FOCAL, 0.0, x, 0.0, FOCAL, y, 0.0, 0.0, 1.0]
        info.p = [FOCAL, 0.0, x, 0.0, 0.0, FOCAL, y, 0.0, 0.0, 0.0, 1.0, 0.0]
        self.infos.publish(info)
        pixels = self.camera.look(self.robot.true)
        message = Image(height=ROWS, width=COLUMNS, encoding="bgr8", step=3 * COLUMNS, header=info.header)
        message.data = pixels.tobytes()
        self.pictures.publish(message)


class Simulation:
    """A run of the robot in its world.

    Args:
        carried: after so many seconds the robot is set down at a pose.
    """

    def __init__(self, robot: RobotNode, driver: DriverNode, carried: tuple[float, Planar] | None = None) -> None:
        self.robot, self.driver, self.carried = robot, driver, carried
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(robot.node)
        self._executor.add_node(driver.node)
        self._stamp = BEGIN
        self._sends = False
        goal = driver.driver.path[-1]
        self.run = Run((float(goal[0]), float(goal[1])))

    def begin(self) -> None:
        """Wait until the node takes pictures and answers; the robot stands meanwhile."""
        robot = self.robot
        self._until(lambda: robot.pictures.get_subscription_count() == 1, "take pictures")
        self._until(lambda: robot.odometry.get_subscription_count() == 2, "listen to odometry")  # and the driver
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            self._stamp += STEP
            self._publish_odometry()
            robot.show(self._stamp)
            if self._spin(lambda: self._number in robot.answers, SOON):
                return
        raise TimeoutError(f"The node placerec answered no picture for {PATIENCE:g} s.")

    def drive(self, most_seconds: float) -> Run:
        """Drive until the driver has arrived, or for so many seconds of the robot's time."""
        robot, run, steps = self.robot.robot, self.run, 0
        while not self.driver.driver.arrived and steps * STEP < most_seconds * SECOND:
            self._stamp += STEP
            steps += 1
            carried = self.carried is not None and steps * STEP >= self.carried[0] * SECOND
            if self.carried is not None and carried:
                robot.carry(self.carried[1])
                self.carried = None
            self._publish_odometry()
            if carried or steps % STEPS_PER_FRAME == 0:
                self._look(carried)
            assert self.robot.command is not None
            command = self.robot.command[1]
            robot.step(command.speed, command.turn, STEP / SECOND)
        run.arrived, run.end, run.bumps = self.driver.driver.arrived, robot.true, robot.bumps
        return run

    @property
    def _number(self) -> int:
        return self._stamp // STEP

    def _publish_odometry(self) -> None:
        """Say where odometry is, and wait until the node's transform, if one is due, and the command have come."""
        self.robot.say(self._stamp)
        if self._sends:
            due = self._stamp + TOLERANCE
            self._until(lambda: (self.driver.correction or (0,))[0] >= due, "send the transform")
        self._until(lambda: (self.robot.command or (0,))[0] >= self._stamp, "say how to drive")

    def _look(self, carried: bool) -> None:
        """Take a picture, and wait for the node's answer to it."""
        self.robot.show(self._stamp)
        self._until(lambda: self._number in self.robot.answers, "answer a picture")
        answer = self.robot.answers[self._number]
        true, odom, filtered = self.robot.robot.true, self.robot.robot.odom, answer["filtered"]
        correction = None if self.driver.correction is None else self.driver.correction[1]
        estimate = None if correction is None else correction.then(odom)
        pose = covariance = None
        if filtered is not None:
            pose = Planar(filtered["x"], filtered["y"], math.radians(filtered["heading"]))
            covariance = np.reshape(filtered["covariance"], (3, 3))
        seconds, localized = (self._stamp - BEGIN) / SECOND, answer["pose_source"] is not None
        frame = Frame(seconds, true, odom, estimate, pose, covariance, answer["verdict"], localized, carried)
        self.run.frames.append(frame)
        self._sends = covariance is not None and _is_sure(covariance)

    def _until(self, done: Callable[[], Any], what: str) -> None:
        if not self._spin(done, PATIENCE):
            raise TimeoutError(f"For {PATIENCE:g} s nobody did this: {what}.")

    def _spin(self, done: Callable[[], Any], patience: float) -> bool:
        end = time.monotonic() + patience
        while not done():
            if time.monotonic() > end:
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True


def _is_sure(covariance: Array) -> bool:
    """Whether the node surely sends the transform: its deviations are well within its limits, and grow little."""
    position, heading = np.linalg.eigvalsh(covariance[:2, :2])[-1], covariance[2, 2]
    return bool(math.sqrt(position) < 0.8 * POSITION and math.sqrt(heading) < 0.8 * HEADING)
