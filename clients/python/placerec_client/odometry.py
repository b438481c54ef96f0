"""Where odometry says that a robot is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from placerec_client import parameters


@dataclass(frozen=True)
class Odometry:
    """A pose in odometry's own frame, as a session's frame carries it.

    The service takes the motion since the last frame that it took in from it, so a frame or an answer that is lost
    loses no motion and counts none twice.

    Args:
        x, y: metres.
        heading: degrees counter-clockwise from +x to where the camera looks.
        covariance: of x, y and heading, nine numbers row by row, in metres and radians as in ROS, as it has grown along
            the way.
        origin: a name for where odometry began, such as a time; give another one when it begins anew.
    """

    x: float
    y: float
    heading: float
    covariance: Sequence[float] | None = None
    origin: str | None = None

    def fields(self) -> parameters.SendFrame:
        """The parameters of a frame that tell the pose."""
        return {
            "odometry_x": self.x,
            "odometry_y": self.y,
            "odometry_heading": self.heading,
            "odometry_covariance": self.covariance,
            "odometry_origin": self.origin,
        }
