"""The static transforms of a robot, and where in the plane a camera stands on it and looks.

Only ``/tf_static`` is followed: ``/tf`` of a moving robot has hundreds of messages a second, which would cost a node in
Python more than its images do.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec_ros.planar import Planar

Array = NDArray[np.float64]

STEEPEST = math.sin(math.radians(60))
"""A camera that looks up or down more steeply than that has no heading that could be used."""


class UnfitMount(Exception):
    """The camera's place on the robot cannot be used; the text is a sentence without its end."""


class StaticFrames:
    """The tree of static transforms as it comes in by ``/tf_static``."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}

    def add(self, transforms: Iterable[Any]) -> None:
        """Take in ``geometry_msgs/TransformStamped``; what has no numbers that make a transform is left out."""
        for one in transforms:
            moved, turned = one.transform.translation, one.transform.rotation
            matrix = transform_of((moved.x, moved.y, moved.z), (turned.x, turned.y, turned.z, turned.w))
            if matrix is not None:
                self._parents[_name(one.child_frame_id)] = _name(one.header.frame_id), matrix

    def between(self, base: str, frame: str) -> Array | None:
        """The pose of a frame in another one, [4, 4]; None if no static transforms connect them."""
        first, second = self._to_root(_name(base)), self._to_root(_name(frame))
        shared = next((name for name in second if name in first), None)
        return None if shared is None else np.linalg.inv(first[shared]) @ second[shared]

    def _to_root(self, frame: str) -> dict[str, Array]:
        """The pose of a frame in itself and in all above it, from itself on."""
        poses, pose = {frame: np.eye(4)}, np.eye(4)
        while frame in self._parents and self._parents[frame][0] not in poses:  # frames in a circle have no root
            frame, matrix = self._parents[frame]
            pose = matrix @ pose
            poses[frame] = pose
        return poses


def transform_of(moved: tuple[float, float, float], turned: tuple[float, float, float, float]) -> Array | None:
    """The matrix of a translation and a quaternion x, y, z, w, [4, 4]; None if they are none."""
    numbers = np.array([*moved, *turned])
    length = float(np.linalg.norm(numbers[3:])) if np.isfinite(numbers).all() else 0.0
    if length < 1e-6:
        return None
    x, y, z, w = numbers[3:] / length
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = moved
    return matrix


def mount_of(camera: Array, frame: str) -> Planar:
    """Where a camera stands on the robot and in which direction it looks.

    Args:
        camera: the pose of its frame in that of the robot, [4, 4].
        frame: its name. In an optical frame, by REP 103 one whose name ends in ``optical_frame`` or ``optical``, z is
            the direction in which the camera looks. In another one it is x if z points up, and z if not.

    Raises:
        UnfitMount: it looks up or down.
    """
    optical = frame.endswith(("optical_frame", "optical")) or abs(camera[2, 1]) > abs(camera[2, 2])
    ahead = camera[:3, 2] if optical else camera[:3, 0]
    if abs(ahead[2]) > STEEPEST:
        steep = math.degrees(math.asin(min(1.0, abs(float(ahead[2])))))
        raise UnfitMount(f"the camera {frame} looks up or down by {steep:.0f}°, so it has no heading")
    x, y, z = map(float, camera[:3, 3])
    return Planar(x, y, math.atan2(float(ahead[1]), float(ahead[0])), z)


def _name(frame: str) -> str:
    return frame.removeprefix("/")
