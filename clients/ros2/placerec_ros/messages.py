"""ROS messages of what the localizer found."""

from __future__ import annotations

import json
import math
from array import array
from collections.abc import Mapping, Sequence

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from sensor_msgs.msg import CompressedImage, NavSatFix, NavSatStatus
from std_msgs.msg import String

from placerec_ros.answers import Answered
from placerec_ros.frame_queue import Frame
from placerec_ros.fusion import FLAT, Fix
from placerec_ros.odometry import NANOSECONDS
from placerec_ros.planar import Datum, Planar, quaternion, yaw_of
from placerec_ros.pose import UNKNOWN_ANGLE, UNKNOWN_HEIGHT, PoseEstimate
from placerec_ros.track import Array


def pose_message(robot: Planar, covariance: Sequence[float], stamp: Time, frame_id: str) -> PoseWithCovarianceStamped:
    """The robot's pose with its covariance, 36 numbers."""
    message = PoseWithCovarianceStamped()
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    pose = message.pose.pose
    pose.position.x, pose.position.y, pose.position.z = robot.x, robot.y, robot.z
    turned = pose.orientation
    turned.x, turned.y, turned.z, turned.w = quaternion(robot.yaw)
    message.pose.covariance = list(covariance)
    return message


def fix_message(found: PoseEstimate, datum: Datum, stamp: Time, frame_id: str) -> NavSatFix:
    """Where the robot is on the Earth; the altitude is NaN where it is not known."""
    message = NavSatFix()
    message.header.stamp, message.header.frame_id = stamp, frame_id
    message.status.status = NavSatStatus.STATUS_FIX
    message.latitude, message.longitude, _ = datum.geographic(found.planar)
    known = datum.altitude is not None and found.covariance[14] < UNKNOWN_HEIGHT
    message.altitude = found.planar.z + (datum.altitude or 0.0) if known else math.nan
    message.position_covariance = np.reshape(found.covariance, (6, 6))[:3, :3].ravel().tolist()
    message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_KNOWN
    return message


def filtered_message(fix: Fix, stamp: Time, frame_id: str) -> PoseWithCovarianceStamped:
    """Where the robot is by all localizations; height, roll and pitch are not filtered and count as not known."""
    covariance = np.diag([0.0, 0.0, UNKNOWN_HEIGHT, UNKNOWN_ANGLE, UNKNOWN_ANGLE, 0.0])
    covariance[FLAT] = fix.track.covariance
    return pose_message(fix.track.robot, covariance.ravel().tolist(), stamp, frame_id)


def given_pose(message: PoseWithCovarianceStamped) -> tuple[Planar, Array]:
    """The pose of a message, and the covariance of its x, y and yaw, [3, 3].

    Raises:
        ValueError: a number is not finite, the orientation is no rotation, or the covariance is none.
    """
    pose, stated = message.pose.pose, np.reshape(np.array(message.pose.covariance, np.float64), (6, 6))[FLAT]
    covariance = (stated + stated.T) / 2
    position, turned = pose.position, pose.orientation
    if not np.isfinite([position.x, position.y, position.z]).all():
        raise ValueError("its position is not finite")
    if not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] < -1e-9:
        raise ValueError("its covariance is none")
    return Planar(position.x, position.y, yaw_of(turned.x, turned.y, turned.z, turned.w), position.z), covariance


def time_message(stamp: int) -> Time:
    """A stamp in nanoseconds."""
    return Time(sec=stamp // NANOSECONDS, nanosec=stamp % NANOSECONDS)


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
