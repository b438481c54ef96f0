"""The track of a robot in the map: localizations and odometry together, by an extended Kalman filter.

Errors of localizations are alike from frame to frame, for frames that are near each other look like the same places. So
most of the error is a state itself, which fades as the robot goes on (a first-order Gauss-Markov process: Bar-Shalom,
Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 8.2). A robot that stands
therefore learns nothing from the same sight again. The lasting error of odometry's scale is a state, too.
"""

from __future__ import annotations

import math
from copy import copy

import numpy as np
from numpy.typing import NDArray

from placerec_ros.planar import Planar, wrapped

Array = NDArray[np.float64]

SCALE = 0.05
"""Standard deviation of the lasting error of odometry's steps, as a share."""
STEP = 0.05
"""Standard deviation of the error of a step of a metre, forward and to the side; of n metres, by the root of n."""
TURN = 0.1
"""Standard deviation of the error of a turn, as a share."""
WANDERING = math.radians(1.0)
"""Standard deviation by which odometry's heading wanders along a metre, in radians."""
ALIKE_METRES, ALIKE_TURN = 30.0, math.radians(90)
"""Metres and radians after which a share of 1/e of the error of localizations is still the same."""
COMMON = 0.5
"""The variance of the error that localizations have in common, by that of a localization."""
OWN = 1.0
"""The variance of the error that each localization has by itself, by that which it states."""
LEAST_POSITION, LEAST_HEADING = 0.1, math.radians(2)
"""Metres and radians: no localization is surer, whatever it says."""
HEIGHT = 0.1
"""Share by which a localization corrects the height, which is no state."""
TYPICAL = (1.0, 1.0, math.radians(10))
"""Standard deviations of a localization in metres and radians, before there is one."""
LIKELY = 11.34
"""Squared normalized innovation of three values that one in a hundred right localizations exceeds (chi square)."""


class Track:
    """One hypothesis of where the robot is, from its first localization on.

    The state is x, y (m) and yaw (rad) in the map, the relative error of odometry's steps, and the common error of
    localizations in x, y and yaw.

    Args:
        robot: the first localization.
        covariance: of its x, y and yaw, [3, 3].
        given: it is no localization, but somebody's word, whose error localizations do not share.
    """

    def __init__(self, robot: Planar, covariance: Array, given: bool = False) -> None:
        self._stated = np.diag(TYPICAL) ** 2 if given else _floored(covariance)
        self._state: Array = np.array([robot.x, robot.y, robot.yaw, *[0.0] * 4])
        self._z = robot.z
        self._covariance: Array = np.zeros((7, 7))
        self._covariance[:3, :3] = (COMMON + OWN) * self._stated
        self._covariance[3, 3] = SCALE**2
        self._covariance[4:, 4:] = COMMON * self._stated
        if given:
            self._covariance[:3, :3] = _floored(covariance)
            return
        self._covariance[:3, 4:] = self._covariance[4:, :3] = -COMMON * self._stated  # by so much the pose is off

    @property
    def robot(self) -> Planar:
        """The robot's pose in the map."""
        x, y, yaw = map(float, self._state[:3])
        return Planar(x, y, wrapped(yaw), self._z)

    @property
    def covariance(self) -> Array:
        """The covariance of x, y and yaw, [3, 3]."""
        return self._covariance[:3, :3].copy()

    def copy(self) -> Track:
        """Another track that is the same."""
        made = copy(self)
        made._state, made._covariance = self._state.copy(), self._covariance.copy()
        return made

    def move(self, step: Planar) -> None:
        """Take in a motion by odometry, in the frame of the robot before it."""
        length, turn = math.hypot(step.x, step.y), abs(step.yaw)
        yaw, factor = float(self._state[2]), 1 + float(self._state[3])
        cos, sin = math.cos(yaw), math.sin(yaw)
        across, along = cos * step.x - sin * step.y, sin * step.x + cos * step.y
        self._state[:3] += (factor * across, factor * along, step.yaw)
        self._z += step.z
        fading = math.exp(-length / ALIKE_METRES - turn / ALIKE_TURN)
        self._state[4:] *= fading
        change = np.eye(7)
        change[:2, 2] = -factor * along, factor * across
        change[:2, 3] = across, along
        change[4:, 4:] *= fading
        noise = np.zeros((7, 7))
        noise[0, 0] = noise[1, 1] = STEP**2 * length
        noise[2, 2] = (TURN * turn) ** 2 + WANDERING**2 * length
        noise[4:, 4:] = (1 - fading**2) * COMMON * self._stated
        self._covariance = change @ self._covariance @ change.T + noise

    def allows(self, robot: Planar, covariance: Array) -> bool:
        """Whether a localization may be right if the track is."""
        off, expected, _ = self._innovation(robot, covariance)
        return float(off @ np.linalg.solve(expected, off)) <= LIKELY

    def correct(self, robot: Planar, covariance: Array) -> None:
        """Take in a localization: a pose, and the covariance of its x, y and yaw, [3, 3]."""
        off, expected, seen = self._innovation(robot, covariance)
        gain = np.linalg.solve(expected, seen @ self._covariance).T
        self._state = self._state + gain @ off
        self._covariance = self._covariance - gain @ expected @ gain.T
        self._covariance = (self._covariance + self._covariance.T) / 2
        self._z += HEIGHT * (robot.z - self._z)
        self._stated = _floored(covariance)

    def _innovation(self, robot: Planar, covariance: Array) -> tuple[Array, Array, Array]:
        """By how much a localization differs, the covariance of that, and how it depends on the state, [3, 7]."""
        seen = np.hstack([np.eye(3), np.zeros((3, 1)), np.eye(3)])
        off = np.array([robot.x, robot.y, robot.yaw]) - seen @ self._state
        off[2] = wrapped(float(off[2]))
        return off, seen @ self._covariance @ seen.T + OWN * _floored(covariance), seen


def _floored(covariance: Array) -> Array:
    """A covariance of x, y and yaw that is not too small."""
    least = np.array([LEAST_POSITION, LEAST_POSITION, LEAST_HEADING]) ** 2
    return (covariance + covariance.T) / 2 + np.diag(least)
