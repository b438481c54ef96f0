"""From localizations and odometry to one transform that does not follow single wrong ones."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from placerec_ros.planar import Planar, map_to_odom
from placerec_ros.pose import UNKNOWN_ANGLE, PoseEstimate
from placerec_ros.track import NO_HEADING, Array, Track

BEGINS = 3
"""Localizations that agree with each other before a track is believed."""
CHANGES, CHANGE_METRES = 5, 5.0
"""Localizations in a row that contradict a track, and agree over so many metres, before it is given up."""
FLAT = np.ix_((0, 1, 5), (0, 1, 5))
"""Where a covariance of ROS, 6 x 6, has those of x, y and the turn about z."""
CONTRADICTED = 0.9
"""The probability that odometry is wrong, at least, where the session finds that it contradicts the frames."""
WAY = 10
"""Localizations over which the ways by odometry and by themselves are compared for a person."""
STANDING = Planar(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Fix:
    """Where the robot is by all localizations up to a frame.

    odom: the robot's pose by odometry at the frame.
    origin: a name for where that odometry began.
    track: as it was after the frame; it is not changed any more.
    moment: of the frame, in seconds.
    confirmed: the moment of the last localization that agreed.
    """

    odom: Planar
    origin: str
    track: Track
    moment: float
    confirmed: float

    @property
    def correction(self) -> Planar:
        """The transform from the map's frame to that of the odometry."""
        return map_to_odom(self.track.robot, self.odom)

    @property
    def deviations(self) -> tuple[float, float]:
        """Standard deviations: of the position, in the direction where it is largest (m), and of the heading (rad)."""
        covariance = self.track.covariance
        across = max(0.0, float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
        return math.sqrt(across), math.sqrt(float(covariance[2, 2]))

    def is_within(self, position: float, heading: float) -> bool:
        """Whether the deviations are at most so many metres and degrees."""
        found = self.deviations
        return found[0] <= position and math.degrees(found[1]) <= heading

    @property
    def unconfirmed(self) -> float:
        """Seconds since the last localization that agreed."""
        return self.moment - self.confirmed

    def at(self, odom: Planar, moment: float) -> Fix:
        """The fix at a later moment, at another pose by odometry, without another localization."""
        track = self.track.copy()
        track.move(self.odom.inverse().then(odom), max(0.0, moment - self.moment))
        return Fix(odom, self.origin, track, max(moment, self.moment), self.confirmed)


@dataclass
class Rival:
    """A track that contradicts the believed one; how many localizations agreed, and the metres driven meanwhile."""

    track: Track
    agreed: int = 1
    driven: float = 0.0


class Fusion:
    """The track that is believed, and a rival, which the localizations begin that contradict it.

    A track is believed when ``BEGINS`` localizations agree. It gives way when ``CHANGES`` in a row contradict it and
    agree with each other over ``CHANGE_METRES``: who stands sees the same wrong place again and again.
    """

    def __init__(self) -> None:
        self.clear()
        self.refused = self.replaced = 0
        """How many localizations contradicted the believed track, and how often a rival has replaced it."""

    def clear(self) -> None:
        """Forget where the robot is, as when it was carried off, or odometry begins anew."""
        self._believed: Track | None = None
        self._rival: Rival | None = None
        self._odom: Planar | None = None
        self._origin = ""
        self._moment = self._confirmed = 0.0
        self._way: deque[tuple[Planar, Planar]] = deque(maxlen=WAY)

    def add(
        self, odom: Planar, origin: str, found: PoseEstimate | None, moment: float, contradicted: bool = False
    ) -> Fix | None:
        """Take in a frame, and return where the robot is by all that came; None if that is not known.

        Args:
            odom: the robot's pose by odometry.
            origin: a name for where that odometry began; with another one everything before is forgotten.
            found: the robot's pose in the map by this frame; None if it was not localized.
            moment: of the frame, in seconds.
            contradicted: whether the session finds that odometry contradicts its frames.
        """
        if origin != self._origin:
            self.clear()
            self._origin = origin
        self._move(odom, moment)
        for track in (self._believed, None if self._rival is None else self._rival.track):
            if contradicted and track is not None:
                track.distrust(CONTRADICTED)
        if found is not None:
            covariance = np.reshape(np.array(found.covariance), (6, 6))[FLAT]
            if covariance[2, 2] >= 0.99 * UNKNOWN_ANGLE:
                covariance[2, :] = covariance[:, 2] = 0.0
                covariance[2, 2] = NO_HEADING
            self._weigh(found.planar, covariance)
        return None if self._believed is None else self._fix(self._believed, odom)

    def place(self, robot: Planar, covariance: Array, odom: Planar, origin: str, moment: float) -> Fix:
        """Believe a pose that somebody gives at a moment, with the covariance of its x, y and yaw, [3, 3]."""
        self.clear()
        self._odom, self._origin, self._moment = odom, origin, moment
        self._believed, self._confirmed = Track(robot, covariance, given=True), moment
        return self._fix(self._believed, odom)

    def _fix(self, track: Track, odom: Planar) -> Fix:
        return Fix(odom, self._origin, track.copy(), self._moment, self._confirmed)

    @property
    def way(self) -> str:
        """The way of the last localizations that agreed, by odometry and by themselves, for a person."""
        if len(self._way) < 2:
            return "there are too few localizations"
        (odom, robot), (last_odom, last_robot) = self._way[0], self._way[-1]
        return f"odometry went {_shown(odom, last_odom)}, the localizations {_shown(robot, last_robot)}"

    def _move(self, odom: Planar, moment: float) -> None:
        seconds = 0.0 if self._odom is None else max(0.0, moment - self._moment)
        self._moment = moment if self._odom is None else max(moment, self._moment)
        step = STANDING if self._odom is None else self._odom.inverse().then(odom)
        self._odom = odom
        if self._believed is not None:
            self._believed.move(step, seconds)
        if self._rival is not None:
            self._rival.track.move(step, seconds)
            self._rival.driven += math.hypot(step.x, step.y)

    def _weigh(self, robot: Planar, covariance: Array) -> None:
        if self._believed is not None and self._believed.allows(robot, covariance):
            self._believed.correct(robot, covariance)
            self._rival = None
            self._confirm(robot)
            return
        self.refused += self._believed is not None
        if self._rival is not None and self._rival.track.allows(robot, covariance):
            self._rival.track.correct(robot, covariance)
            self._rival.agreed += 1
            self._settle(self._rival)
        elif covariance[2, 2] < NO_HEADING:
            self._rival = Rival(Track(robot, covariance))

    def _settle(self, rival: Rival) -> None:
        """Believe the rival if it has earned it."""
        if self._believed is None:
            earned = rival.agreed >= BEGINS
        else:
            earned = rival.agreed >= CHANGES and rival.driven >= CHANGE_METRES
        if earned:
            self.replaced += self._believed is not None
            self._believed, self._rival = rival.track, None
            self._way.clear()
            self._confirm(rival.track.robot)

    def _confirm(self, robot: Planar) -> None:
        """Note a localization that agreed."""
        self._confirmed = self._moment
        if self._odom is not None:
            self._way.append((self._odom, robot))


def _shown(before: Planar, after: Planar) -> str:
    """A way in words: how far, in which direction, and how far it turned."""
    step = before.inverse().then(after)
    ahead, turned = math.degrees(math.atan2(step.y, step.x)), math.degrees(step.yaw)
    return f"{math.hypot(step.x, step.y):.1f} m at {ahead:.0f}° from its front and turned by {turned:.0f}°"
