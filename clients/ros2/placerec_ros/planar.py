"""Positions and headings in the plane: transforms, and the plane in which a map in degrees is driven."""

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


EQUATOR, FLATTENING = 6_378_137.0, 1 / 298.257223563
"""Radius of the Earth at the equator in metres, and its flattening (WGS 84)."""


@dataclass(frozen=True)
class Datum:
    """The origin of a map's frame on the Earth: x leads east from it, y north, and degrees become metres there.

    The plane touches the ellipsoid of WGS 84 at the datum; a kilometre away it is wrong by about a decimetre.
    ``altitude`` is that of z = 0, in metres above the ellipsoid; without one heights are not told.
    """

    latitude: float
    longitude: float
    altitude: float | None = None

    def height(self, altitude: float | None) -> float | None:
        """The z of an altitude; None if it or that of the datum is not known."""
        return None if altitude is None or self.altitude is None else altitude - self.altitude

    def planar(self, latitude: float, longitude: float, heading: float | None) -> Planar:
        """A pose in degrees, the heading clockwise from north; without one, the yaw is 0."""
        east, north = self._metres()
        x = (longitude - self.longitude + 180) % 360 - 180
        yaw = 0.0 if heading is None else wrapped(math.radians(90 - heading))
        return Planar(x * east, (latitude - self.latitude) * north, yaw)

    def geographic(self, pose: Planar) -> tuple[float, float, float]:
        """Latitude, longitude and heading of a pose, in degrees, the heading in [0, 360)."""
        east, north = self._metres()
        longitude = (self.longitude + pose.x / east + 180) % 360 - 180
        return self.latitude + pose.y / north, longitude, (90 - math.degrees(pose.yaw)) % 360

    def _metres(self) -> tuple[float, float]:
        """Metres of a degree of longitude and of one of latitude, by the radii of curvature at the datum."""
        squared = FLATTENING * (2 - FLATTENING)
        sine, cosine = math.sin(math.radians(self.latitude)), math.cos(math.radians(self.latitude))
        across = EQUATOR / math.sqrt(1 - squared * sine * sine)
        along = across * (1 - squared) / (1 - squared * sine * sine)
        return math.radians(across * cosine), math.radians(along)
