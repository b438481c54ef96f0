"""What may be wrong with the odometry of a robot that otherwise goes its way."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from benchmarks.day.walks import PlanarPose


@dataclass(frozen=True)
class OdometryFault:
    """What odometry says in place of what the wheels measure.

    length: metres for a metre; ``still``: it says the same all the time.
    turn: by which its heading is off, in radians, counter-clockwise.
    radians: whether the number of the heading is in radians, where degrees are expected.
    """

    length: float = 1.0
    still: bool = False
    turn: float = 0.0
    radians: bool = False


FAULTS = {
    "frozen": OdometryFault(still=True),
    "0.3 as long": OdometryFault(length=0.3),
    "3 times as long": OdometryFault(length=3.0),
    "turned by 180°": OdometryFault(turn=np.pi),
    "in camera axes": OdometryFault(turn=np.pi / 2),
    "in radians": OdometryFault(radians=True),
}


@dataclass
class StatedOdometry:
    """Where odometry says that the robot is, from what its wheels measure."""

    pose: PlanarPose = field(default_factory=lambda: PlanarPose(0.0, 0.0, 0.0))
    _wheels: PlanarPose | None = None

    def at(self, wheels: PlanarPose, fault: OdometryFault | None) -> PlanarPose:
        """The pose that is said next."""
        before, self._wheels = self._wheels or wheels, wheels
        fault = fault or OdometryFault()
        if fault.still:
            return self.pose
        x, y = (
            old + fault.length * (now - then)
            for old, now, then in zip(self.pose[:2], wheels[:2], before[:2], strict=True)
        )
        heading = wheels.heading + fault.turn
        self.pose = PlanarPose(x, y, float(np.radians(heading)) if fault.radians else heading)
        return self.pose
