"""What an operator is told of a recording's path before its frames are enrolled, and when they are refused."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.errors import InvalidTrajectory
from core.places import EARTH_RADIUS
from core.recordings.frame import RecordedFrame
from core.recordings.recording import Recording

MOST_LOST = 0.1
"""The share of frames that may lose their pose without anybody's consent."""


def traverse_of(name: str, frame: RecordedFrame) -> str:
    """The traverse of a frame in a recording of a name; of a later part with coordinates of its own ``NAME~2``."""
    return name if frame.segment == 1 else f"{name}~{frame.segment}"


def check_lost_poses(recording: Recording, remarked: bool = False) -> None:
    """Refuse a recording of which more than a tenth of the frames lose their pose.

    Args:
        remarked: whether the reasons were shown already.

    Raises:
        InvalidTrajectory: they do; the text has the reasons, and the option that allows it.
    """
    count = len(recording.frames)
    if recording.lost > MOST_LOST * count:
        reasons = ", for what is remarked above." if remarked else f": {' '.join(recording.lost_by)}"
        raise InvalidTrajectory(
            f"{recording.lost} of {count} frames lose their pose, more than a tenth{reasons} "
            "Nothing is enrolled. --allow-lost-poses enrols such frames without a pose; where poses leap, --most-speed "
            "says how fast the vehicle can be."
        )


def way_of(frames: Sequence[RecordedFrame]) -> str | None:
    """The length and the extent of the frames' path, and how many have a pose, as words; None if none has one."""
    poses = [pose for frame in frames if (pose := frame.pose) is not None]
    if not poses:
        return None
    kinds = {pose.kind() for pose in poses}
    points = np.array([pose.position() for pose in poses])
    parts = np.array([frame.segment for frame in frames if frame.pose is not None])
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)[np.diff(parts) == 0]
    if kinds == {"geographic"}:
        degrees = np.array([[pose.latitude or 0.0, pose.longitude or 0.0] for pose in poses])
        degrees[:, 1] = (degrees[:, 1] - degrees[0, 1] + 180) % 360 - 180  # across the meridian of 180 degrees
        north, east = np.radians(np.ptp(degrees, axis=0)) * EARTH_RADIUS
        extent = (east * float(np.cos(np.radians(degrees[:, 0].mean()))), north)
    else:
        extent = tuple(np.ptp(points[:, :2], axis=0))
    with_pose = f"{len(poses)} of {len(frames)} frames with a pose"
    if len(kinds) > 1:
        return f"poses in metres and in degrees, {with_pose}"
    return f"path {_metres(float(steps.sum()))} m, extent {_metres(extent[0])} × {_metres(extent[1])} m, {with_pose}"


def _metres(length: float) -> str:
    digits = 1 if length < 10 else 0
    return f"{length:,.{digits}f}".replace(",", " ")
