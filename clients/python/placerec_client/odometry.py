"""Where odometry says that a robot is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

from placerec_client import parameters
from placerec_client.errors import InvalidOdometry
from placerec_client.requests import number_of, wrapped

MOST = {"x": 1e8, "y": 1e8, "heading": 1e6, "forward": 1e5, "left": 1e5, "turn": 36000.0}
"""How large numbers may be that can have either sign, as at the service."""

LARGEST_COVARIANCE, LONGEST_ORIGIN = 1e12, 128
UNITS = {"x": "metres", "y": "metres", "heading": "degrees", "forward": "metres", "left": "metres", "turn": "degrees"}


@dataclass(frozen=True)
class Odometry:
    """A pose in odometry's own frame, as a session's frame carries it.

    The service takes the motion since the last frame that it took in from it, so a frame or an answer that is lost
    loses no motion and counts none twice.

    Args:
        x, y: metres.
        heading: degrees counter-clockwise from +x to where the camera looks; it wraps, so that 370 is 10.
        covariance: of x, y and heading, nine numbers row by row, in metres and radians as in ROS, as it has grown along
            the way.
        origin: a name for where odometry began, such as a time; give another one when it begins anew.

    Raises:
        InvalidOdometry: the service would refuse it, such as for a number that is not finite.
    """

    x: float
    y: float
    heading: float
    covariance: Sequence[float] | None = None
    origin: str | None = None

    def __post_init__(self) -> None:
        for name in ("x", "y", "heading"):
            _check_number(name, getattr(self, name))
        if self.covariance is not None:
            _check_covariance(self.covariance)
        if self.origin is not None and not (isinstance(self.origin, str) and len(self.origin) <= LONGEST_ORIGIN):
            raise InvalidOdometry(f"origin has to be a text of at most {LONGEST_ORIGIN} characters.")

    def fields(self) -> parameters.SendFrame:
        """The parameters of a frame that give the pose."""
        return {
            "odometry_x": self.x,
            "odometry_y": self.y,
            "odometry_heading": wrapped(float(self.heading)),
            "odometry_covariance": self.covariance,
            "odometry_origin": self.origin,
        }


def with_motion(options: parameters.SendFrame, odometry: Odometry | None) -> parameters.SendFrame:
    """The options of a frame, and in them the pose by odometry; both are checked.

    Raises:
        InvalidOdometry: ``odometry`` is of another type, or a motion is no number that the service takes.
    """
    for name in ("forward", "left", "turn"):
        value = cast("dict[str, Any]", options).get(name)
        if value is not None:
            _check_number(name, value)
    if odometry is None:
        return options
    if not isinstance(odometry, Odometry):
        raise InvalidOdometry(
            f"odometry has to be an Odometry, not a {type(odometry).__name__}: "
            "give Odometry(x, y, heading), in metres and degrees."
        )
    return {**options, **odometry.fields()}


def _check_number(name: str, value: Any) -> None:
    number = number_of(value)
    if number is None or not abs(number) <= MOST[name]:
        raise InvalidOdometry(
            f"{name} has to be a finite number of {UNITS[name]}, at most {MOST[name]:.0f} either way."
        )


def _check_covariance(covariance: Any) -> None:
    """Raise InvalidOdometry unless these are nine numbers of a symmetric matrix without negative variances."""
    listed = [] if isinstance(covariance, str) or not hasattr(covariance, "__iter__") else list(covariance)
    numbers = [number for number in map(number_of, listed) if number is not None and abs(number) <= LARGEST_COVARIANCE]
    if len(numbers) != 9 or len(listed) != 9:
        raise InvalidOdometry("covariance has to be nine finite numbers, those of x, y and heading row by row.")
    alike = (math.isclose(numbers[i], numbers[j], rel_tol=1e-6, abs_tol=1e-9) for i, j in ((1, 3), (2, 6), (5, 7)))
    if not all(alike) or min(numbers[0], numbers[4], numbers[8]) < 0:
        raise InvalidOdometry("covariance has to be that of a symmetric matrix without negative variances.")
