"""Messages of bags: which are pictures, which are poses, and when they were taken.

The definitions of ROS 1 and ROS 2 are those that came with ROS, which no release has changed but for the header's
``seq`` of ROS 1.  Those of Foxglove, in protobuf or JSON, are in the file itself: fields are read by their names.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Sequence
from functools import cache, lru_cache
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from core.errors import InvalidRecording, MissingExtra
from core.frames.intrinsics import Intrinsics
from core.recordings.frame import NANOSECONDS
from core.recordings.pictures import compressed_file, image_png

Coding = Literal["cdr", "ros1", "protobuf", "json"]
"""How a message is written: by ROS 2, by ROS 1, or as Foxglove's schemas are."""

COMPRESSED, IMAGE = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
FOXGLOVE_COMPRESSED, FOXGLOVE_IMAGE = "foxglove.CompressedImage", "foxglove.RawImage"
IMAGE_TYPES = (COMPRESSED, IMAGE, FOXGLOVE_COMPRESSED, FOXGLOVE_IMAGE)
VIDEO_TYPES = (
    "theora_image_transport/msg/Packet",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
    "foxglove_msgs/msg/CompressedVideo",
    "foxglove.CompressedVideo",
)
"""Packets of a video, which are named where pictures are missing."""
FIX, FOXGLOVE_FIX = "sensor_msgs/msg/NavSatFix", "foxglove.LocationFix"
FIXES = (FIX, FOXGLOVE_FIX)
TRANSFORMS, FOXGLOVE_TRANSFORM, FOXGLOVE_TRANSFORMS = (
    "tf2_msgs/msg/TFMessage",
    "foxglove.FrameTransform",
    "foxglove.FrameTransforms",
)
TRANSFORM_TYPES = (TRANSFORMS, "tf/msg/tfMessage", FOXGLOVE_TRANSFORM, FOXGLOVE_TRANSFORMS)
POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    FIX,
    "foxglove.PoseInFrame",
    FOXGLOVE_FIX,
    *TRANSFORM_TYPES,
)
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
MOST_COEFFICIENTS = 8
"""Of a lens that is known."""
STAMP_BYTES = 16
"""The first bytes of a message of ROS, in which its stamp is."""
WHOLE: tuple[Coding, ...] = ("protobuf", "json")
"""Codings whose stamps may be anywhere in a message."""
MOST_SCHEMAS = 64
"""Schemas of protobuf that are held ready."""


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


def stamp_of(data: bytes | memoryview, coding: Coding, kind: str = "", schema: bytes = b"") -> int:
    """The stamp in the header of a message, nanoseconds; 0 if it is not set, or if the message has no header.

    Args:
        data: the first ``STAMP_BYTES`` of the message; of the codings ``WHOLE`` all of it.
        kind, schema: of the message, as of ``picture_of``.
    """
    if kind in TRANSFORM_TYPES:
        return 0  # each transform has one of its own
    if coding in WHOLE:
        try:
            return _nanoseconds(_decoded(bytes(data), kind, coding, schema).timestamp)
        except (InvalidRecording, AttributeError, TypeError, ValueError, OverflowError):
            return 0
    try:
        if coding == "ros1":
            _, seconds, nanoseconds = struct.unpack_from("<3I", data)
        else:
            seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    except (struct.error, IndexError):
        return 0
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def picture_of(data: bytes, kind: str, coding: Coding, schema: bytes = b"") -> bytes:
    """The bytes that are sent of a picture's message: JPEG, PNG or WebP files as they are, all else as PNG.

    Args:
        kind: one of ``IMAGE_TYPES``.
        schema: of protobuf: the file descriptors that define the message.

    Raises:
        InvalidRecording: the message is damaged.
        InvalidImage: it holds no picture that can be used.
    """
    message = _decoded(data, kind, coding, schema)
    try:
        if kind in (IMAGE, FOXGLOVE_IMAGE):
            return image_png(_raw_of(message) if kind == FOXGLOVE_IMAGE else message)
        return compressed_file(str(getattr(message, "format", "")), _bytes_of(message.data))
    except (AttributeError, TypeError, ValueError) as error:
        raise InvalidRecording(f"A message is damaged: it is no {kind}.") from error


def frame_of(data: bytes, kind: str, coding: Coding, schema: bytes = b"") -> str:
    """The frame of a picture's message, such as that of the camera; empty if it names none.

    Raises:
        InvalidRecording: the message is damaged.
    """
    message = _decoded(data, kind, coding, schema)
    return str(getattr(message.header if hasattr(message, "header") else message, "frame_id", ""))


def intrinsics_of(data: bytes, coding: Coding, rectified: bool = False) -> Intrinsics:
    """The intrinsics of the published frames in a message of the type ``CAMERA_INFO``, its binning and region applied.

    Args:
        rectified: the frames are rectified: by the projection matrix P, without distortion.

    Raises:
        InvalidRecording: the message is damaged, the camera not calibrated, or its lens none that is known.
    """
    message = _decoded(data, CAMERA_INFO, coding, b"")
    matrix = [float(one) for one in (_either(message, "p") if rectified else _either(message, "k"))]
    fx, cx, fy, cy = (matrix[at] for at in ((0, 2, 5, 6) if rectified else (0, 2, 4, 5)))
    bent = [] if rectified else [float(one) for one in _either(message, "d")]
    region, whole = message.roi, (0, 0, message.width, message.height)
    published = (region.x_offset, region.y_offset, region.width, region.height)
    left, top, width, height = published if region.width and region.height else whole
    across, down = max(message.binning_x, 1), max(message.binning_y, 1)
    known = len(bent) <= MOST_COEFFICIENTS or not any(bent[MOST_COEFFICIENTS:])  # longer lists end in zeros
    try:
        return Intrinsics.model_validate(
            {
                "width": int(width) // across,
                "height": int(height) // down,
                "fx": fx / across,
                "fy": fy / down,
                "cx": (cx - left + 0.5) / across - 0.5,  # the centre of the first pixel is at 0, before and after
                "cy": (cy - top + 0.5) / down - 0.5,
                "distortion_model": str(message.distortion_model) if any(bent) else "none",
                "distortion": tuple(bent[:MOST_COEFFICIENTS] if known else bent) if any(bent) else (),
            }
        )
    except ValidationError as error:
        why = "; ".join(f"{'.'.join(map(str, one['loc'])) or 'they'}: {one['msg']}" for one in error.errors()[:3])
        raise InvalidRecording(f"The intrinsics of its CameraInfo cannot be used: {why}.") from error


def _either(message: Any, name: str) -> Any:
    """A field that ROS 1 writes with a capital."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())


class PoseSaid(NamedTuple):
    """The pose in a message.

    position: float64 [3], metres, or latitude and longitude in degrees and the height above the ellipsoid, NaN if it is
        not known; numbers are as they are written, also if they are none.
    turn: float64 [4], the quaternion x, y, z, w, NaN where it is not known.
    frame, child: the names of the frame in which the pose is, and of the frame whose pose it is; empty if not named.
    """

    position: NDArray[np.float64]
    turn: NDArray[np.float64]
    frame: str
    child: str


def pose_of(data: bytes, kind: str, coding: Coding, schema: bytes = b"") -> PoseSaid | None:
    """The pose in a message of ``POSE_TYPES`` that is none of ``TRANSFORM_TYPES``; None if it states to have no fix.

    Raises:
        InvalidRecording: the message is damaged.
    """
    message = _decoded(data, kind, coding, schema)
    try:
        found = _fix_in(message) if kind in FIXES else _pose_in(message)
        frame = str(getattr(message.header if hasattr(message, "header") else message, "frame_id", ""))
        return found and PoseSaid(*found, frame.removeprefix("/"), str(getattr(message, "child_frame_id", "")))
    except (AttributeError, TypeError, ValueError) as error:
        raise InvalidRecording(f"A message is damaged: it is no {kind}.") from error


UNKNOWN_TURN = (math.nan,) * 4


def _fix_in(message: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    altitude = float(message.altitude)
    stated = math.isfinite(altitude) and altitude != 0.0  # what was left out reads as 0
    place = np.array([float(message.latitude), float(message.longitude), altitude if stated else math.nan])
    has_fix = not hasattr(message, "status") or message.status.status >= 0
    return (place, np.array(UNKNOWN_TURN)) if has_fix else None


def _pose_in(message: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    position = np.array([float(getattr(pose.position, axis)) for axis in "xyz"])
    return position, unit_turn([float(getattr(pose.orientation, axis)) for axis in "xyzw"])


def unit_turn(numbers: Sequence[float]) -> NDArray[np.float64]:
    """A quaternion x, y, z, w of length 1, float64 [4]; NaN if the numbers are none."""
    turn = np.array(numbers, np.float64)
    length = math.hypot(*turn.tolist())
    return turn / length if math.isfinite(length) and length > 1e-6 else np.array(UNKNOWN_TURN)


class Transform(NamedTuple):
    """A transform of a message: the pose of ``child`` in ``parent``.

    stamp: nanoseconds; 0 if there is none.
    moved: float64 [3], metres.
    turned: float64 [4], the quaternion x, y, z, w; NaN if it is none.
    """

    parent: str
    child: str
    stamp: int
    moved: NDArray[np.float64]
    turned: NDArray[np.float64]


def transforms_of(data: bytes, kind: str, coding: Coding, schema: bytes = b"") -> list[Transform]:
    """The transforms of a message of ``TRANSFORM_TYPES``, also those whose numbers are none.

    Raises:
        InvalidRecording: the message is damaged.
    """
    message = _decoded(data, kind, coding, schema)
    try:
        listed = [message] if kind == FOXGLOVE_TRANSFORM else list(message.transforms)
        return [_foxglove_transform(one) if kind in _OF_FOXGLOVE else _ros_transform(one) for one in listed]
    except (AttributeError, TypeError, ValueError) as error:
        raise InvalidRecording(f"A message is damaged: it is no {kind}.") from error


_OF_FOXGLOVE = (FOXGLOVE_TRANSFORM, FOXGLOVE_TRANSFORMS)


def _ros_transform(one: Any) -> Transform:
    stamp = one.header.stamp
    taken = int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
    moved, turned = one.transform.translation, one.transform.rotation
    return _transform(one.header.frame_id, one.child_frame_id, taken, moved, turned)


def _foxglove_transform(one: Any) -> Transform:
    taken = _nanoseconds(one.timestamp)
    return _transform(one.parent_frame_id, one.child_frame_id, taken, one.translation, one.rotation)


def _transform(parent: str, child: str, stamp: int, moved: Any, turned: Any) -> Transform:
    return Transform(
        parent.removeprefix("/"),
        child.removeprefix("/"),
        stamp,
        np.array([float(getattr(moved, axis)) for axis in "xyz"]),
        unit_turn([float(getattr(turned, axis)) for axis in "xyzw"]),
    )


def _nanoseconds(timestamp: Any) -> int:
    """A time of Foxglove's: of protobuf, or of its JSON."""
    if hasattr(timestamp, "seconds"):
        return int(timestamp.seconds) * NANOSECONDS + int(timestamp.nanos)
    return int(timestamp.sec) * NANOSECONDS + int(timestamp.nsec)


def _bytes_of(data: Any) -> bytes:
    """Bytes as they are, or those of JSON's base64."""
    return base64.b64decode(data, validate=True) if isinstance(data, str) else bytes(memoryview(data))


def _raw_of(message: Any) -> SimpleNamespace:
    """Foxglove's raw pixels as those of ROS, which are little-endian there."""
    names = ("width", "height", "encoding", "step")
    fields = {name: getattr(message, name) for name in names}
    return SimpleNamespace(**fields, data=np.frombuffer(_bytes_of(message.data), np.uint8), is_bigendian=0)


def _decoded(data: bytes, kind: str, coding: Coding, schema: bytes) -> Any:
    if coding == "protobuf":
        return _protobuf(data, kind, schema)
    if coding == "json":
        return _json(data, kind)
    store = _types(coding)
    try:
        return store.deserialize_ros1(data, kind) if coding == "ros1" else store.deserialize_cdr(data, kind)
    except Exception as error:  # rosbags' own, struct's, NumPy's: all errors that malformed bytes cause
        raise InvalidRecording(f"A message is damaged: it is no {kind}.") from error


@cache
def _types(coding: Coding) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if coding != "ros1":
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)  # which has none of tf's
    for kind in (TRANSFORMS, "tf/msg/tfMessage"):
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store


def _json(data: bytes, kind: str) -> Any:
    try:
        found = json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))
    except (ValueError, RecursionError) as error:
        raise InvalidRecording(f"A message is damaged: it is no {kind}.") from error
    if not isinstance(found, SimpleNamespace):
        raise InvalidRecording(f"A message is damaged: it is no {kind}.")
    return found


def _protobuf(data: bytes, kind: str, schema: bytes) -> Any:
    from google.protobuf.message import DecodeError

    try:
        return _message_class(schema, kind).FromString(data)
    except DecodeError as error:
        raise InvalidRecording(f"A message is damaged: it is no {kind}.") from error


@lru_cache(MOST_SCHEMAS)
def _message_class(schema: bytes, kind: str) -> Any:
    """The class of a message that a FileDescriptorSet defines.

    Raises:
        InvalidRecording: it does not.
    """
    from google.protobuf import descriptor_pool, message_factory
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    pool = descriptor_pool.DescriptorPool()
    try:
        waiting = {file.name: file for file in FileDescriptorSet.FromString(schema).file}
        while waiting:  # a file can be added once those are there on which it depends
            ready = [name for name, file in waiting.items() if not waiting.keys() & set(file.dependency)]
            if not ready:
                raise ValueError("its files depend on each other in a circle")
            for name in ready:
                pool.Add(waiting.pop(name))
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(kind))
    except Exception as error:  # protobuf's own, TypeError, KeyError: all errors that a malformed schema causes
        raise InvalidRecording(f"The schema of {kind} is damaged or incomplete.") from error
