"""ROS messages of what the localizer found."""

from __future__ import annotations

import json
from array import array
from collections.abc import Mapping

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import String

from placerec_ros.frame_queue import Frame
from placerec_ros.localizer import Answered
from placerec_ros.planar import Planar, quaternion


def pose_message(answered: Answered, frame_id: str) -> PoseWithCovarianceStamped:
    """The robot's pose, with the stamp of its image."""
    assert answered.estimate is not None and answered.robot is not None
    message = PoseWithCovarianceStamped()
    message.header.stamp = answered.frame.message.header.stamp
    message.header.frame_id = frame_id
    pose, robot = message.pose.pose, answered.robot
    pose.position.x, pose.position.y, pose.position.z = robot.x, robot.y, robot.z
    turned = pose.orientation
    turned.x, turned.y, turned.z, turned.w = quaternion(robot.yaw)
    message.pose.covariance = list(answered.estimate.covariance)
    return message


def transform_message(correction: Planar, stamp: Time, parent: str, child: str) -> TransformStamped:
    """The transform from the map's frame to that of the odometry."""
    message = TransformStamped()
    message.header.stamp, message.header.frame_id, message.child_frame_id = stamp, parent, child
    moved, turned = message.transform.translation, message.transform.rotation
    moved.x, moved.y, moved.z = correction.x, correction.y, correction.z
    turned.x, turned.y, turned.z, turned.w = quaternion(correction.yaw)
    return message


def answer_message(answered: Answered) -> String:
    """The answer as JSON."""
    return String(data=json.dumps(answered.report, separators=(",", ":")))


def picture_message(frame: Frame, png: bytes) -> CompressedImage:
    """A PNG with the header of the frame that it shows."""
    message = CompressedImage(header=frame.message.header, format="png")
    message.data = array("B", png)
    return message


def diagnostics_message(
    level: int, text: str, values: Mapping[str, str], name: str, url: str, now: Time
) -> DiagnosticArray:
    """The node's state as ``/diagnostics`` has it."""
    status = DiagnosticStatus(level=bytes([level]), name=name, message=text, hardware_id=url)
    status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
    message = DiagnosticArray(status=[status])
    message.header.stamp = now
    return message
