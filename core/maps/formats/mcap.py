"""A map as an MCAP file of ROS 2 messages, which Foxglove, rosbag2 and ``placerec enrol`` read.

Of each traverse, under the topic of its name: the pictures and the intrinsics of each camera
(``sensor_msgs/CompressedImage``, ``CameraInfo``), the poses (``geometry_msgs/PoseStamped``) and, of a map in degrees,
the positions (``sensor_msgs/NavSatFix``).  The poses of such a map are metres about its first place.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import cos, nan, sin
from pathlib import Path
from typing import Any

import numpy as np

from core.maps.formats.frames import ArchivedFrame, ArchivedFrames
from core.places import microseconds
from core.recordings.frame import NANOSECONDS
from core.recordings.messages import check_installed

MAP = "map"
"""The frame of the poses, and the topic of places that belong to no traverse."""
FORMATS = {".jpg": "jpeg", ".png": "png", ".webp": "webp"}
FIX, KNOWN_NOT = 0, 0
"""NavSatStatus.STATUS_FIX, and NavSatFix.COVARIANCE_TYPE_UNKNOWN."""


@dataclass
class McapFile:
    """The outcome of writing a file: how many frames it has, and how many of them have a pose."""

    frames: int = 0
    posed: int = 0


class _Messages:
    """Writes messages of ROS 2, each topic as a channel of its type."""

    def __init__(self, file: Any) -> None:
        from mcap.writer import Writer
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self._writer = Writer(file)
        self._writer.start("ros2", library="placerec")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._tokens: dict[str, str] = {}

    def token(self, name: str) -> str:
        """A part of topics for a name, which no other name has: letters, digits and _, as ROS demands."""
        if name not in self._tokens:
            made = re.sub(r"[^A-Za-z0-9_]+", "_", name).strip("_")
            made = made if made[:1].isalpha() else f"t_{made}"
            while made in self._tokens.values():
                made += "_"
            self._tokens[name] = made
        return self._tokens[name]

    def make(self, kind: str, **fields: Any) -> Any:
        """A message or a part of one."""
        return self.store.types[kind](**fields)

    def write(self, topic: str, kind: str, stamp: int, message: Any) -> None:
        """Write a message at its stamp, nanoseconds."""
        if kind not in self._schemas:
            text, _ = self.store.generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind])
        data = bytes(self.store.serialize_cdr(message, kind))
        self._writer.add_message(self._channels[topic], stamp, data, stamp)

    def finish(self) -> None:
        """End the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]

    def header(self, stamp: int, frame: str) -> Any:
        """The header of a message."""
        seconds, rest = divmod(stamp, NANOSECONDS)
        time = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)


def write_mcap(frames: ArchivedFrames, path: Path) -> McapFile:
    """Write the frames of a map as a new file.

    Raises:
        MissingExtra: the writer of bags is not installed.
        InvalidArchive: the export file is damaged.
        OSError: the file cannot be written.
    """
    check_installed()
    made = McapFile()
    with path.open("wb") as file:
        messages = _Messages(file)
        for frame in frames:
            made.frames += 1
            made.posed += _write(messages, frame)
        messages.finish()
    return made


def _write(messages: _Messages, frame: ArchivedFrame) -> bool:
    """Write all messages of a frame; whether it has a pose."""
    stamp = max(0, 1000 * microseconds(frame.taken))
    traverse = "/" + messages.token(frame.place.sequence or MAP)
    camera = f"{traverse}/{messages.token(frame.camera)}"
    head = messages.header(stamp, frame.camera)
    picture = messages.make(
        "sensor_msgs/msg/CompressedImage",
        header=head,
        format=FORMATS[frame.suffix],
        data=np.frombuffer(frame.data, np.uint8),
    )
    messages.write(f"{camera}/image/compressed", "sensor_msgs/msg/CompressedImage", stamp, picture)
    if frame.intrinsics is not None:
        messages.write(
            f"{camera}/camera_info", "sensor_msgs/msg/CameraInfo", stamp, _camera_info(messages, frame, head)
        )
    pose = frame.place.pose
    if pose is not None and pose.latitude is not None:
        messages.write(f"{traverse}/fix", "sensor_msgs/msg/NavSatFix", stamp, _fix(messages, frame, head))
    if frame.stands is not None:
        kind = "geometry_msgs/msg/PoseStamped"
        messages.write(f"{traverse}/pose", kind, stamp, _pose(messages, frame, messages.header(stamp, MAP)))
    return frame.stands is not None


def _pose(messages: _Messages, frame: ArchivedFrame, head: Any) -> Any:
    """The pose; its quaternion is all zeros, which is none, where the heading is not known."""
    assert frame.stands is not None
    x, y, z = map(float, frame.stands.position)
    yaw = frame.stands.yaw
    turn = (0.0, 0.0) if yaw is None else (sin(yaw / 2), cos(yaw / 2))
    position = messages.make("geometry_msgs/msg/Point", x=x, y=y, z=z)
    turned = messages.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=turn[0], w=turn[1])
    pose = messages.make("geometry_msgs/msg/Pose", position=position, orientation=turned)
    return messages.make("geometry_msgs/msg/PoseStamped", header=head, pose=pose)


def _fix(messages: _Messages, frame: ArchivedFrame, head: Any) -> Any:
    pose = frame.place.pose
    assert pose is not None
    return messages.make(
        "sensor_msgs/msg/NavSatFix",
        header=head,
        status=messages.make("sensor_msgs/msg/NavSatStatus", status=FIX, service=0),
        latitude=pose.latitude,
        longitude=pose.longitude,
        altitude=nan if pose.z is None else pose.z,
        position_covariance=np.zeros(9),
        position_covariance_type=KNOWN_NOT,
    )


def _camera_info(messages: _Messages, frame: ArchivedFrame, head: Any) -> Any:
    known = frame.intrinsics
    assert known is not None
    roi = messages.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    matrix = known.matrix()
    return messages.make(
        "sensor_msgs/msg/CameraInfo",
        header=head,
        height=known.height,
        width=known.width,
        distortion_model="plumb_bob" if known.distortion_model == "none" else known.distortion_model,
        d=np.array(known.distortion or [0.0] * 5, np.float64),
        k=matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([matrix, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )
