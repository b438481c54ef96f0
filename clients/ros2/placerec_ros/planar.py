"""Positions and headings in the plane, and the transform between the map's and the odometry's frame."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Planar:
    """A pose or a transform: metres, and radians counter-clockwise from +x. ``z`` is carried along."""

    x: float
    y: float
    yaw: float
    z: float = 0.0

    def then(self, other: Planar) -> Planar:
        """This transform, and after it ``other``, which is given in this one's frame."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return Planar(
            self.x + cos * other.x - sin * other.y,
            self.y + sin * other.x + cos * other.y,
            wrapped(self.yaw + other.yaw),
            self.z + other.z,
        )

    def inverse(self) -> Planar:
        """The transform that undoes this one."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return Planar(-cos * self.x - sin * self.y, sin * self.x - cos * self.y, wrapped(-self.yaw), -self.z)


def wrapped(angle: float) -> float:
    """The same angle in (-π, π]."""
    return math.pi - (math.pi - angle) % (2 * math.pi)


def quaternion(yaw: float) -> tuple[float, float, float, float]:
    """The quaternion x, y, z, w of a turn about z."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """The heading of a quaternion: the direction of its x axis, seen from above.

    Raises:
        ValueError: it is no rotation: its length is 0 or not a number.
    """
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not math.isfinite(length) or length < 1e-6:
        raise ValueError("the orientation is no rotation: its quaternion has no length")
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def map_to_odom(in_map: Planar, in_odom: Planar) -> Planar:
    """The transform from the map's frame to that of the odometry, by the robot's pose in both."""
    return in_map.then(in_odom.inverse())
