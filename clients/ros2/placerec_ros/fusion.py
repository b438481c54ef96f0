"""From localizations and odometry to one transform that does not follow single wrong ones."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from placerec_ros.planar import Planar, map_to_odom
from placerec_ros.pose import UNKNOWN_ANGLE, PoseEstimate
from placerec_ros.track import Array, Track

BEGINS = 3
"""Localizations that agree with each other before a track is believed."""
CHANGES, CHANGE_METRES = 5, 5.0
"""Localizations in a row that contradict a track, and agree over so many metres, before it is given up."""
FLAT = np.ix_((0, 1, 5), (0, 1, 5))
"""Where a covariance of ROS, 6 x 6, has those of x, y and the turn about z."""
NO_HEADING = 1e6
"""The variance in rad² by which a heading that is not known has no weight."""
STANDING = Planar(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Fix:
    """Where the robot is by all localizations up to a frame.

    odom: the robot's pose by odometry at the frame.
    origin: a name for where that odometry began.
    track: as it was after the frame; it is not changed any more.
    """

    odom: Planar
    origin: str
    track: Track

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

    def at(self, odom: Planar) -> Fix:
        """The fix after the robot has gone on to a pose by odometry, without another localization."""
        track = self.track.copy()
        track.move(self.odom.inverse().then(odom))
        return Fix(odom, self.origin, track)


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

    def add(self, odom: Planar, origin: str, found: PoseEstimate | None) -> Fix | None:
        """Take in a frame, and return where the robot is by all that came; None if that is not known.

        Args:
            odom: the robot's pose by odometry.
            origin: a name for where that odometry began; with another one everything before is forgotten.
            found: the robot's pose in the map by this frame; None if it was not localized.
        """
        if origin != self._origin:
            self.clear()
            self._origin = origin
        self._move(odom)
        if found is not None:
            covariance = np.reshape(np.array(found.covariance), (6, 6))[FLAT]
            if covariance[2, 2] >= 0.99 * UNKNOWN_ANGLE:
                covariance[2, :] = covariance[:, 2] = 0.0
                covariance[2, 2] = NO_HEADING
            self._weigh(found.planar, covariance)
        return None if self._believed is None else Fix(odom, origin, self._believed.copy())

    def place(self, robot: Planar, covariance: Array, odom: Planar, origin: str) -> Fix:
        """Believe a pose that somebody gives, with the covariance of its x, y and yaw, [3, 3]."""
        self.clear()
        self._believed, self._odom, self._origin = Track(robot, covariance, given=True), odom, origin
        return Fix(odom, origin, self._believed.copy())

    def _move(self, odom: Planar) -> None:
        step = STANDING if self._odom is None else self._odom.inverse().then(odom)
        self._odom = odom
        if self._believed is not None:
            self._believed.move(step)
        if self._rival is not None:
            self._rival.track.move(step)
            self._rival.driven += math.hypot(step.x, step.y)

    def _weigh(self, robot: Planar, covariance: Array) -> None:
        if self._believed is not None and self._believed.allows(robot, covariance):
            self._believed.correct(robot, covariance)
            self._rival = None
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
