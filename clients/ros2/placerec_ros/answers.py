"""What follows from an answer: where the robot is by all of them, whether odometry agrees, and what is given out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from placerec_ros.frame_queue import Frame
from placerec_ros.fusion import Fix, Fusion
from placerec_ros.health import Health
from placerec_ros.odometry import NANOSECONDS, Odometer
from placerec_ros.planar import Planar
from placerec_ros.pose import PoseEstimate
from placerec_ros.track import Array


@dataclass(frozen=True)
class Answered:
    """An answer with what follows from it.

    report: the answer that is published as JSON.
    robot: the robot's pose in the map by this answer; None while it is not localized.
    fix: where it is by all answers and odometry; None without odometry of the frame, or if that is not known.
    """

    frame: Frame
    report: dict[str, Any]
    estimate: PoseEstimate | None
    robot: Planar | None
    fix: Fix | None


class Outlet(Protocol):
    """Where results go; the worker's thread calls it."""

    def answered(self, answered: Answered) -> None: ...

    def wants_picture(self) -> bool: ...

    def picture(self, frame: Frame, png: bytes) -> None: ...


class Following:
    """The robot on its way: the filter, and what the diagnostics say of it. The worker's thread calls it."""

    def __init__(self, odometer: Odometer, health: Health) -> None:
        self._odometer, self._health = odometer, health
        self._fusion = Fusion()
        self.fix: Fix | None = None
        """Where the robot is by all answers so far; None if that is not known. Any thread may read it."""

    def take(self, frame: Frame, answer: Mapping[str, Any], found: PoseEstimate | None) -> Fix | None:
        """Take in an answer, and say so if odometry contradicts the frames, by the session or by the filter.

        Args:
            found: the robot's pose in the map by this answer; None if it gives none.

        Returns:
            Where the robot was at the frame; None if that is not known, or if odometry has nothing of then.
        """
        fix = self._fuse(frame, found, answer.get("motion") == "contradicted")
        self._judge_odometry(answer, fix)
        return fix

    def place(self, robot: Planar, covariance: Array, odom: Planar, stamp: int) -> None:
        """Believe a pose that somebody gives, with the covariance of x, y and yaw, [3, 3]; its stamp in nanoseconds."""
        self.fix = self._fusion.place(robot, covariance, odom, self._odometer.origin, stamp / NANOSECONDS)

    def forget(self) -> None:
        """Forget where the robot is."""
        self._fusion.clear()
        self._health.over("contradiction")
        self.fix = None

    def _fuse(self, frame: Frame, found: PoseEstimate | None, contradicted: bool) -> Fix | None:
        odom = self._odometer.at(frame.stamp) if frame.stamp else None
        if odom is None:
            return None
        self.fix = self._fusion.add(odom, self._odometer.origin, found, frame.stamp / NANOSECONDS, contradicted)
        self._health.counts["localizations refused"] = self._fusion.refused
        self._health.counts["tracks replaced"] = self._fusion.replaced
        return self.fix

    def _judge_odometry(self, answer: Mapping[str, Any], fix: Fix | None) -> None:
        if answer.get("motion") is not None:
            self._health.fact("motion", answer["motion"])
        if answer.get("motion") == "contradicted":
            kind = answer.get("contradiction") or "inconsistent"
            why = answer.get("contradiction_note") or "its motion and the frames do not agree"
            self._health.fact("contradiction", kind)
            self._health.begins("contradiction", f"Odometry contradicts the frames ({kind}): {why}.")
        elif fix is not None and fix.track.doubt > 0.5:
            self._health.fact("contradiction", "inconsistent")
            self._health.begins("contradiction", f"Odometry contradicts the localizations: {self._fusion.way}.")
        else:
            self._health.fact("contradiction", "none")
            self._health.over("contradiction")


def filtered(fix: Fix) -> dict[str, Any]:
    """Where the robot is by all answers, for the JSON: metres, degrees, and the covariance of x, y and yaw, in rad."""
    robot = fix.track.robot
    covariance = fix.track.covariance.ravel().tolist()
    return {"x": robot.x, "y": robot.y, "heading": math.degrees(robot.yaw) % 360, "covariance": covariance}
