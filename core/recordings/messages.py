"""ROS messages: which are pictures, which are poses, and when they were taken; of ROS 1 and ROS 2.

The definitions are those that came with ROS, which no release has changed but for the header's ``seq`` of ROS 1.
"""

from __future__ import annotations

import math
import struct
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidRecording, MissingExtra
from core.recordings.frame import NANOSECONDS
from core.recordings.pictures import image_pixels, png, sendable

Coding = Literal["cdr", "ros1"]
"""How a message is written: by ROS 2 or by ROS 1."""

COMPRESSED, IMAGE = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
IMAGE_TYPES = (COMPRESSED, IMAGE)
FIX = "sensor_msgs/msg/NavSatFix"
POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    FIX,
)
STAMP_BYTES = 16
"""The first bytes of a message, in which its stamp is."""


def check_installed() -> None:
    """Check that the reader of bags is installed.

    Raises:
        MissingExtra: it is not.
    """
    try:
        import mcap  # noqa: F401
        import rosbags  # noqa: F401
    except ImportError as error:
        raise MissingExtra(
            "Bags need packages that are not installed: pip install 'placerec[bags]', or in a checkout "
            ".venv/bin/pip install --editable '.[bags]'."
        ) from error


def type_name(name: str) -> str:
    """A type as ROS 2 writes it: ``sensor_msgs/Image`` becomes ``sensor_msgs/msg/Image``."""
    package, _, kind = name.partition("/")
    return name if "/" in kind or not kind else f"{package}/msg/{kind}"


def stamp_of(data: bytes | memoryview, coding: Coding) -> int:
    """The stamp in the header of a message, nanoseconds; 0 if it is not set, or if the message has no header."""
    try:
        if coding == "ros1":
            _, seconds, nanoseconds = struct.unpack_from("<3I", data)
        else:
            seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    except (struct.error, IndexError):
        return 0
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def picture_of(data: bytes, kind: str, coding: Coding) -> bytes:
    """The bytes that are sent of a picture's message: JPEG, PNG or WebP files as they are, all else as PNG.

    Raises:
        InvalidRecording: the message is damaged.
        InvalidImage: it holds no picture that can be used.
    """
    message = _decoded(data, kind, coding)
    return sendable(bytes(message.data)) if kind == COMPRESSED else png(image_pixels(message))


def pose_of(data: bytes, kind: str, coding: Coding) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """The position and the orientation in a message of ``POSE_TYPES``.

    Returns:
        float64 [3], metres, or latitude and longitude in degrees and 0; and float64 [4], the quaternion x, y, z, w, NaN
        where it is not known.  None if the message has no position: it has no fix, or numbers that are not finite.

    Raises:
        InvalidRecording: the message is damaged.
    """
    message = _decoded(data, kind, coding)
    unknown = np.full(4, math.nan)
    if kind == FIX:
        place = np.array([message.latitude, message.longitude, 0.0])
        usable = (
            message.status.status >= 0 and np.isfinite(place).all() and abs(place[0]) <= 90 and abs(place[1]) <= 180
        )
        return (place, unknown) if usable else None
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    position = np.array([pose.position.x, pose.position.y, pose.position.z])
    turn = np.array([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
    if not np.isfinite(position).all():
        return None
    length = float(np.linalg.norm(turn))
    return position, turn / length if math.isfinite(length) and length > 1e-6 else unknown


def _decoded(data: bytes, kind: str, coding: Coding) -> Any:
    store = _types(coding)
    try:
        return store.deserialize_ros1(data, kind) if coding == "ros1" else store.deserialize_cdr(data, kind)
    except Exception as error:  # rosbags' own, struct's, NumPy's: all errors that malformed bytes cause
        raise InvalidRecording(f"A message is damaged: it is no {kind}.") from error


@cache
def _types(coding: Coding) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if coding == "ros1" else Stores.ROS2_HUMBLE)
