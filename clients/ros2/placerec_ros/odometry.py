"""Odometry: where the robot was at the moment of a frame, and how it moved between two frames."""

from __future__ import annotations

import math
import threading
from bisect import bisect_left, insort
from dataclasses import dataclass
from typing import Any

from placerec_ros.planar import Planar, wrapped, yaw_of

KEPT_SECONDS = 10.0
LARGEST_GAP = 0.5
"""Seconds between two messages of odometry across which a pose is interpolated."""
LATEST = 0.1
"""Seconds by which the last message may be older than a frame: odometry may come a little later than the frame."""
CLOCK_JUMP = 1.0
"""Seconds by which a stamp may be older than the last one before the clock counts as set back."""
MOST_KEPT = 10_000

NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Increment:
    """The motion between two frames, in the robot's coordinates at the first: metres and degrees."""

    forward: float
    left: float
    turn: float


def stamp_of(message: Any) -> int:
    """The stamp of a message in nanoseconds."""
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


class Odometer:
    """The last seconds of odometry; one thread may feed it while others ask."""

    def __init__(self) -> None:
        self._poses: list[tuple[int, Planar]] = []
        self._lock = threading.Lock()
        self.frame = ""
        """The frame of the odometry's poses, such as ``odom``; empty before the first message."""
        self.child = ""
        """The frame of the robot, such as ``base_link``."""

    def add(self, message: Any) -> None:
        """Take in a ``nav_msgs/Odometry``.

        Raises:
            ValueError: its pose is none: a number is not finite, or the orientation is no rotation.
        """
        stamp, pose = stamp_of(message), message.pose.pose
        position, turned = pose.position, pose.orientation
        if not all(math.isfinite(one) for one in (position.x, position.y, position.z)):
            raise ValueError("the position is not finite")
        planar = Planar(position.x, position.y, yaw_of(turned.x, turned.y, turned.z, turned.w), position.z)
        with self._lock:
            frame = message.header.frame_id
            if frame != self.frame or (self._poses and stamp < self._poses[-1][0] - CLOCK_JUMP * NANOSECONDS):
                self._poses.clear()  # another odometry, or the clock was set back as by a bag that begins again
            self.frame, self.child = frame, message.child_frame_id
            if not self._poses or stamp > self._poses[-1][0]:
                self._poses.append((stamp, planar))
            else:
                insort(self._poses, (stamp, planar), key=lambda one: one[0])
            oldest = self._poses[-1][0] - int(KEPT_SECONDS * NANOSECONDS)
            if self._poses[0][0] < oldest - NANOSECONDS or len(self._poses) > MOST_KEPT:
                first = max(bisect_left(self._poses, oldest, key=lambda one: one[0]), len(self._poses) - MOST_KEPT)
                del self._poses[:first]

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._poses.clear()
            self.frame = self.child = ""

    def at(self, stamp: int) -> Planar | None:
        """The pose at a moment, in nanoseconds; None if no odometry is near it."""
        widest = int(LARGEST_GAP * NANOSECONDS)
        with self._lock:
            place = bisect_left(self._poses, stamp, key=lambda one: one[0])
            if place == len(self._poses):
                near = self._poses and stamp - self._poses[-1][0] <= LATEST * NANOSECONDS
                return self._poses[-1][1] if near else None
            after = self._poses[place]
            if after[0] == stamp:
                return after[1]
            if place == 0:
                return None
            before = self._poses[place - 1]
        if after[0] - before[0] > widest:
            return None
        share = (stamp - before[0]) / (after[0] - before[0])
        first, second = before[1], after[1]
        return Planar(
            first.x + share * (second.x - first.x),
            first.y + share * (second.y - first.y),
            wrapped(first.yaw + share * wrapped(second.yaw - first.yaw)),
            first.z + share * (second.z - first.z),
        )


def increment(before: Planar, after: Planar, camera_yaw: float = 0.0) -> Increment:
    """The motion between two poses of the robot.

    Args:
        camera_yaw: radians by which the camera looks to the left of the robot's front; the motion is that of the
            camera, as headings of a map are.
    """
    looking = Planar(0.0, 0.0, camera_yaw)
    moved = before.then(looking).inverse().then(after.then(looking))
    return Increment(moved.x, moved.y, math.degrees(moved.yaw))
