"""Where odometry says that the robot is, and the motion between two such poses.

A pose is sent anew with every frame, so that nothing is lost or counted twice if a frame or an answer to it is lost:
the motion is always the one since the last frame that was taken in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from core.belief.motion import Odometry

FASTEST = 100.0
"""Metres per second.  Odometry that reports a faster motion has begun anew, or was set."""


@dataclass(frozen=True)
class OdometryPose:
    """A pose in the odometry's own frame.

    x, y: metres.
    heading: radians, counter-clockwise from +x.
    covariance: of x, y and heading, nine numbers row by row, in metres and radians; it grows along the way.  None: it
        is not known.
    origin: a name for where the odometry began; poses with different ones have nothing to do with each other.
    """

    x: float
    y: float
    heading: float
    covariance: tuple[float, ...] | None = None
    origin: str | None = None

    def since(self, before: OdometryPose) -> Odometry:
        """The motion from an earlier pose of the same origin to this one, in the robot's coordinates at that pose.

        The excess of this pose's covariance over the earlier one, as it is carried along by the motion, is that of the
        motion; it is never negative.  It is 0 if either is not known.
        """
        east, north = self.x - before.x, self.y - before.y
        cos, sin = math.cos(before.heading), math.sin(before.heading)
        turn = math.remainder(self.heading - before.heading, 2 * math.pi)
        variance = turn_variance = 0.0
        if self.covariance is not None and before.covariance is not None:
            xx, _, xh, _, yy, yh, _, _, hh = before.covariance
            carried = xx - 2 * north * xh + north**2 * hh + yy + 2 * east * yh + east**2 * hh
            variance = max(0.0, 0.5 * (self.covariance[0] + self.covariance[4] - carried))
            turn_variance = max(0.0, self.covariance[8] - hh)
        return Odometry(cos * east + sin * north, cos * north - sin * east, turn, variance, turn_variance)


def motion_between(before: OdometryPose | None, now: OdometryPose, farthest: float | None) -> Odometry | None:
    """The motion between the poses of two frames that follow one another.

    Args:
        before: None if the earlier frame had no pose.
        farthest: metres that the robot cannot have gone beyond in between; None if that is not known.

    Returns:
        None if the motion is not known: odometry has begun anew, by its origin or by how far it has jumped.
    """
    if before is None or before.origin != now.origin:
        return None
    motion = now.since(before)
    return None if farthest is not None and motion.distance > farthest else motion
