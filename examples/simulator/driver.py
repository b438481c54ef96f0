"""A plain driver: pure pursuit (Coulter, Implementation of the pure pursuit path tracking algorithm, 1992)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from examples.simulator.world import Array
from placerec_ros.planar import Planar

SPEED, SLOW = 1.0, 0.5
"""Metres a second: along the path, and where the robot turns sharply or does not know where it is."""
AHEAD = 1.5
"""Metres of the path from the point nearest to the robot to that for which it heads."""
LOST = 3.0
"""Metres from that part of the path on which the robot should be, beyond which it is looked for on all of it."""
FASTEST_TURN = 1.0
"""Radians a second."""
ARRIVED = 0.5
"""Metres from the goal at which the robot stops."""


@dataclass(frozen=True)
class Command:
    """Metres a second ahead, and radians a second to the left."""

    speed: float
    turn: float


class Driver:
    """Follows a path through the map to its end.

    Args:
        waypoints: of the path, x and y in metres, [n, 2].
    """

    def __init__(self, waypoints: Sequence[tuple[float, float]]) -> None:
        self.path = _dense(np.array(waypoints, np.float64))
        self.arrived = False
        self._along = 0  # the point of the path at which the robot is

    def command(self, robot: Planar | None) -> Command:
        """The next command, by the robot's pose in the map; it drives on slowly while that is not known."""
        if robot is None:
            return Command(SLOW, 0.0)
        self._follow(robot)
        if self.arrived:
            return Command(0.0, 0.0)
        target = self.path[min(self._along + round(AHEAD / STEP), len(self.path) - 1)]
        aim = robot.inverse().then(Planar(float(target[0]), float(target[1]), 0.0))
        distance, angle = math.hypot(aim.x, aim.y), math.atan2(aim.y, aim.x)
        speed = SPEED if abs(angle) < 0.5 else SLOW
        if abs(angle) > math.pi / 2:
            return Command(0.0, math.copysign(FASTEST_TURN, angle))
        turn = 2 * speed * math.sin(angle) / max(distance, 0.1)
        return Command(speed, max(-FASTEST_TURN, min(FASTEST_TURN, turn)))

    def _follow(self, robot: Planar) -> None:
        """Find the point of the path at which the robot is: a little further, or anywhere if the path is not near."""
        away = np.hypot(*(self.path - [robot.x, robot.y]).T)
        further = away[self._along : self._along + round(2 * AHEAD / STEP)]
        near = float(further.min()) <= LOST
        self._along = self._along + int(further.argmin()) if near else int(away.argmin())
        self.arrived = self.arrived or (
            self._along + round(2 * AHEAD / STEP) >= len(away) and bool(away[-1] <= ARRIVED)
        )


STEP = 0.1
"""Metres from point to point of a path."""


def _dense(waypoints: Array) -> Array:
    """Points along straight lines through waypoints, [n, 2]."""
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(waypoints, axis=0).T))])
    at = np.arange(0.0, lengths[-1] + STEP / 2, STEP)
    return np.stack([np.interp(at, lengths, waypoints[:, 0]), np.interp(at, lengths, waypoints[:, 1])], axis=1)
