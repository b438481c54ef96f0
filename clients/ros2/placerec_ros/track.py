"""The track of a robot in the map: localizations and odometry together, by an extended Kalman filter.

Errors of localizations are alike from frame to frame, for frames that are near each other look like the same places. So
most of the error is a state itself, which fades as the robot goes on (a first-order Gauss-Markov process: Bar-Shalom,
Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 8.2). A robot that stands
therefore learns nothing from the same sight again. The lasting error of odometry's scale is a state, too.

Odometry may fail, so there are two models, each with a state of its own and a probability (interacting multiple models:
the same book, section 11.6.6). In one, odometry is right. In the other it says nothing: the robot goes on as the
localizations have shown, and less surely with time. A localization may be wrong in both, and counts by the probability
that it is not (probabilistic data association: Bar-Shalom and Tse, Tracking in a cluttered environment, 1975). Until
the models are told apart, the mean of the last innovations says by how much the pose is off, and widens it.
"""

from __future__ import annotations

import math
from copy import copy

import numpy as np
from numpy.typing import NDArray

from placerec_ros.planar import Planar, wrapped
from placerec_ros.pose import UNKNOWN_ANGLE

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
NO_HEADING = 1e6
"""The variance in rad² of a heading that is not known."""
TRUSTED, ADRIFT = 0, 1
"""The models: odometry is right; it says nothing of the motion."""
AT_FIRST = 0.05
"""The probability that odometry is wrong from the start."""
FAILS, MENDS = 600.0, 3600.0
"""Seconds after which odometry fails, and is mended, on average.  Chosen on the simulated walks of
tests/clients/ros2/navigation/walks.py: FAILS of 300 and 1000 change the shares there by less than 0.002, and a robot
that is not localized is uncertain by three metres after 11 s and 17 s.  With MENDS of 1000, a scale of 0.3 is believed
again at stops (0.002 more poses beyond three deviations), with 10000 odometry that is mended is believed after 8.5 s
instead of 8."""
PACE, FASTEST = 1.5, 10.0
"""Metres a second, root mean square: of a robot adrift at least, for odometry may have said more, and at most."""
GUST = 0.5
"""Standard deviation of the velocity when odometry has just failed, by that of a robot adrift."""
LASTING = 5.0
"""Seconds after which a share of 1/e of the velocity of a robot adrift is still the same."""
TURNING = math.radians(30)
"""Standard deviation of the turn of a robot adrift in a second; in n seconds, by the root of n."""
WRONG, WITHIN = 0.05, 20.0
"""The probability that a localization is wrong, and the standard deviation in metres of where it then is."""
RECENT = 0.5
"""The weight of the last innovation in their mean.  On the same walks, a third leaves 0.003 more poses beyond three
deviations after a failure."""
WHITE = 6.0
"""Squared normalized mean of the innovations, of three values, above which it is evidence against odometry: twice that
of right odometry.  On the same walks 3 to 9 are alike but for odometry turned by 90°."""
POSITION, HEADING = slice(0, 2), slice(2, 3)
FADES, VELOCITY = slice(4, 7), slice(7, 9)
"""Where a state has them."""
SEEN = np.hstack([np.eye(3), np.zeros((3, 1)), np.eye(3), np.zeros((3, 2))])
"""How x, y and yaw of a localization depend on the state, [3, 9]."""


class Track:
    """One hypothesis of where the robot is, from its first localization on.

    The state is x, y (m) and yaw (rad) in the map, the relative error of odometry's steps, the common error of
    localizations in x, y and yaw, and the velocity along x and y (m/s).

    Args:
        robot: the first localization.
        covariance: of its x, y and yaw, [3, 3].
        given: it is no localization, but somebody's word, whose error localizations do not share.
    """

    def __init__(self, robot: Planar, covariance: Array, given: bool = False) -> None:
        self._stated = np.diag(TYPICAL) ** 2 if given else _floored(covariance)
        self._z, self._speed = robot.z, PACE
        first: Array = np.diag([0.0] * 3 + [SCALE**2] + [0.0] * 3 + [PACE**2] * 2)
        first[:3, :3] = _floored(covariance) if given else (COMMON + OWN) * self._stated
        first[FADES, FADES] = COMMON * self._stated
        if not given:
            first[:3, FADES] = first[FADES, :3] = -COMMON * self._stated  # by so much the pose is off
        self._states: Array = np.tile([robot.x, robot.y, robot.yaw, *[0.0] * 6], (2, 1))
        self._covariances: Array = np.tile(first, (2, 1, 1))
        self._weights: Array = np.array([1 - AT_FIRST, AT_FIRST])
        self._innovations: Array = np.zeros(3)  # their mean
        self._excess: Array = np.zeros((3, 3))

    @property
    def robot(self) -> Planar:
        """The robot's pose in the map, by the likelier model."""
        x, y, yaw = map(float, self._states[int(np.argmax(self._weights)), :3])
        return Planar(x, y, wrapped(yaw), self._z)

    @property
    def covariance(self) -> Array:
        """The covariance of x, y and yaw about the pose, by both models, [3, 3]."""
        return self._about_best(self._weights)[1][:3, :3] + self._excess

    @property
    def doubt(self) -> float:
        """The probability that odometry does not say how the robot moves."""
        return float(self._weights[ADRIFT])

    def copy(self) -> Track:
        """Another track that is the same."""
        made = copy(self)
        made._states, made._covariances = self._states.copy(), self._covariances.copy()
        made._weights, made._innovations = self._weights.copy(), self._innovations.copy()
        return made

    def distrust(self, least: float) -> None:
        """Let the probability that odometry is wrong be so large at least."""
        doubt = max(least, self.doubt)
        self._weights = np.array([1 - doubt, doubt])

    def move(self, step: Planar, seconds: float) -> None:
        """Take in a motion by odometry, in the frame of the robot before it, that took so many seconds."""
        self._switch(seconds)
        self._z += step.z
        self._follow(step, seconds)
        self._drift(seconds)

    def _switch(self, seconds: float) -> None:
        """Let odometry have failed, or been mended, meanwhile."""
        fails, mends = 1 - math.exp(-seconds / FAILS), 1 - math.exp(-seconds / MENDS)
        joint = self._weights[:, None] * np.array([[1 - fails, fails], [mends, 1 - mends]])
        self._weights = joint.sum(axis=0)
        mixed = [self._joined(shares / shares.sum()) for shares in joint.T]
        self._states, self._covariances = np.stack([one for one, _ in mixed]), np.stack([one for _, one in mixed])

    def _joined(self, weights: Array) -> tuple[Array, Array]:
        """Mean and covariance of the state if the models have these probabilities, [9] and [9, 9]."""
        mean, covariance = self._about_best(weights)
        return self._states[int(np.argmax(weights))] + mean, covariance - np.outer(mean, mean)

    def _about_best(self, weights: Array) -> tuple[Array, Array]:
        """Mean and second moment of the state about that of the likelier model, [9] and [9, 9]."""
        off = self._states - self._states[int(np.argmax(weights))]
        off[:, 2] = [wrapped(float(yaw)) for yaw in off[:, 2]]
        spread = np.einsum("m,mi,mj->ij", weights, off, off)
        return weights @ off, np.einsum("m,mij->ij", weights, self._covariances) + spread

    def _follow(self, step: Planar, seconds: float) -> None:
        """Predict the state that trusts odometry."""
        state = self._states[TRUSTED]
        length, turn = math.hypot(step.x, step.y), abs(step.yaw)
        yaw, factor = float(state[2]), 1 + float(state[3])
        cos, sin = math.cos(yaw), math.sin(yaw)
        across, along = cos * step.x - sin * step.y, sin * step.x + cos * step.y
        change, noise = np.eye(9), np.zeros(9)
        change[:2, 2] = -factor * along, factor * across
        change[:2, 3] = across, along
        state[:3] += (factor * across, factor * along, step.yaw)
        noise[POSITION] = STEP**2 * length
        noise[HEADING] = (TURN * turn) ** 2 + WANDERING**2 * length
        if seconds > 0:
            self._speed = max(self._speed, min(length / seconds, FASTEST))
            state[VELOCITY] = factor * across / seconds, factor * along / seconds
            change[VELOCITY] = 0.0
            noise[VELOCITY] = (GUST * self._speed) ** 2
        self._predict(TRUSTED, change, np.diag(noise), math.exp(-length / ALIKE_METRES - turn / ALIKE_TURN))

    def _drift(self, seconds: float) -> None:
        """Predict the state of a robot adrift, whose velocity fades: the integrated Ornstein-Uhlenbeck process."""
        stays = math.exp(-seconds / LASTING)
        reach = LASTING * (1 - stays)
        change, noise = np.eye(9), np.zeros((9, 9))
        for place, speed in ((0, 7), (1, 8)):
            change[place, speed], change[speed, speed] = reach, stays
            noise[place, place] = self._speed**2 * (2 * LASTING * (seconds - reach) - reach**2)
            noise[place, speed] = noise[speed, place] = self._speed**2 * reach * (1 - stays)
            noise[speed, speed] = self._speed**2 * (1 - stays**2)
        noise[2, 2] = min(TURNING**2 * seconds, UNKNOWN_ANGLE)
        self._states[ADRIFT] = change @ self._states[ADRIFT]
        self._predict(ADRIFT, change, noise, math.exp(-self._speed * seconds / ALIKE_METRES))

    def _predict(self, model: int, change: Array, noise: Array, fading: float) -> None:
        """Predict a covariance, and let the common error of localizations fade."""
        self._states[model, FADES] *= fading
        change[FADES, FADES] *= fading
        noise[FADES, FADES] = (1 - fading**2) * COMMON * self._stated
        self._covariances[model] = change @ self._covariances[model] @ change.T + noise

    def allows(self, robot: Planar, covariance: Array) -> bool:
        """Whether a localization is likelier right than wrong, if the track is right."""
        return float(self._weights @ self._odds(robot, covariance)) >= 1

    def correct(self, robot: Planar, covariance: Array) -> None:
        """Take in a localization: a pose, and the covariance of its x, y and yaw, [3, 3]."""
        self._note(robot, covariance)
        odds = self._odds(robot, covariance)
        for model, right in enumerate(odds / (odds + 1)):
            off, expected, seen = self._innovation(model, robot, covariance)
            gain = np.linalg.solve(expected, seen @ self._covariances[model]).T
            moved = gain @ off
            changed = self._covariances[model] - right * gain @ expected @ gain.T
            changed += right * (1 - right) * np.outer(moved, moved)
            self._states[model] += right * moved
            self._covariances[model] = (changed + changed.T) / 2
        self._weights = self._weights * (odds + 1)
        self._weights /= self._weights.sum()
        self._z += HEIGHT * (robot.z - self._z)
        self._stated = _floored(covariance)

    def _note(self, robot: Planar, covariance: Array) -> None:
        """Take in by how much a localization is away from the pose, and widen the pose by a mean that is too large.

        The means of right odometry are about zero, for its innovations are white.
        """
        mean, within = self._joined(self._weights)
        off = np.array([robot.x, robot.y, robot.yaw]) - mean[:3]
        off[2] = wrapped(float(off[2])) if covariance[2, 2] < NO_HEADING else 0.0
        self._innovations = self._innovations + RECENT * (off - self._innovations)
        expected = within[:3, :3] + (COMMON + OWN * RECENT / (2 - RECENT)) * _floored(covariance)
        self._excess, total = np.zeros((3, 3)), 0.0
        for part in (POSITION, HEADING):
            found = self._innovations[part]
            surprise = float(found @ np.linalg.solve(expected[part, part], found))
            total += surprise
            if surprise > len(found):
                self._excess[part, part] = np.outer(found, found)
        self._weights[TRUSTED] *= math.exp(-0.5 * max(0.0, total - WHITE))
        self._weights /= self._weights.sum()

    def _odds(self, robot: Planar, covariance: Array) -> Array:
        """The odds that a localization is right, in each model, [2]."""
        found = []
        for model in (TRUSTED, ADRIFT):
            off, expected, _ = self._innovation(model, robot, covariance)
            right = math.exp(-0.5 * float(off @ np.linalg.solve(expected, off)))
            right /= math.sqrt(float(np.linalg.det(2 * math.pi * expected)))
            wrong = 1 / (2 * math.pi * WITHIN**2) / (2 * math.pi) ** (len(off) - 2)
            found.append((1 - WRONG) / WRONG * right / wrong)
        return np.array(found)

    def _innovation(self, model: int, robot: Planar, covariance: Array) -> tuple[Array, Array, Array]:
        """By how much a localization differs, the covariance of that, and how it depends on the state, [n, 9].

        n is 3, or 2 where it has no heading.
        """
        off = np.array([robot.x, robot.y, robot.yaw]) - SEEN @ self._states[model]
        off[2] = wrapped(float(off[2]))
        expected = SEEN @ self._covariances[model] @ SEEN.T + OWN * _floored(covariance)
        count = 3 if covariance[2, 2] < NO_HEADING else 2
        return off[:count], expected[:count, :count], SEEN[:count]


def _floored(covariance: Array) -> Array:
    """A covariance of x, y and yaw that is not too small."""
    least = np.array([LEAST_POSITION, LEAST_POSITION, LEAST_HEADING]) ** 2
    return (covariance + covariance.T) / 2 + np.diag(least)
