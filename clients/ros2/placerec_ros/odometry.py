"""Odometry: where the robot was at the moment of a frame."""

from __future__ import annotations

import math
import threading
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from placerec_client import Odometry
from placerec_ros.planar import Planar, wrapped, yaw_of

HISTORY_SECONDS = 10.0
LARGEST_GAP = 0.5
"""Seconds between two messages of odometry across which a pose is interpolated."""
LATEST = 0.1
"""Seconds by which the last message may be older than a frame: odometry may come a little later than the frame."""
CLOCK_JUMP = 1.0
"""Seconds by which a stamp may be older than the last one before the clock counts as set back."""
MOST_POSES = 10_000
FASTEST = 100.0
"""Metres a second. No robot is faster, whatever is known of it."""
GAINED = 2.0
"""Metres a second by which a robot becomes faster in a second."""
AWAY = 1.0
"""Metres that a pose may be farther away than the robot can have gone; farther, and odometry has begun anew."""
RETURN = 2.0
"""Seconds in which odometry that has leapt may go on where it was: the messages between were none of it."""
SETTLED = 5
"""Messages in a row after which odometry that has begun anew is no wrong message."""
MOST_RUNS, RUNS_WITHIN, BY_FAR = 6, 10.0, 4
"""If odometry leaps and returns so often in so many seconds, and one side has not by far more messages, two publishers
alternate on its topic."""
OVER_LIMIT = 2.0
"""How many times the limit of its speed a robot may seem to go, as the service has it."""
FLAT = (0, 1, 5, 6, 7, 11, 30, 31, 35)
"""Where a covariance of ROS, 6 x 6, has those of x, y and the turn about z."""
LARGEST_COVARIANCE = 1e12
"""The service takes no larger entries."""

NANOSECONDS = 1_000_000_000


Covariance = tuple[float, ...]


class Located(NamedTuple):
    """Where the robot was at a moment by odometry.

    origin: a name for where this odometry began.
    settled: whether odometry has gone on for some messages since it began, and nothing else comes between.
    """

    pose: Planar
    origin: str
    settled: bool


class Left(NamedTuple):
    """Odometry before it leapt: its readings, its frame, and the number of its beginning."""

    readings: list[Reading]
    frame: str
    number: int


@dataclass(frozen=True)
class Reading:
    """The content of a message of odometry.

    stamp: nanoseconds.
    speed: metres a second, by the twist; 0 if the message has none.
    covariance: of x, y and yaw, nine numbers row by row; None if the message has none that can be used.
    """

    stamp: int
    pose: Planar
    speed: float
    covariance: Covariance | None


def stamp_of(message: Any) -> int:
    """The stamp of a message in nanoseconds."""
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


class Odometer:
    """The last seconds of odometry; one thread may feed it while others ask.

    Args:
        speed_limit: metres a second that the robot does not exceed; 0: not known.
    """

    def __init__(self, speed_limit: float = 0.0) -> None:
        self._fastest = min(FASTEST, OVER_LIMIT * speed_limit) if speed_limit else FASTEST
        self._poses: list[Reading] = []
        self._lock = threading.Lock()
        self._beginnings = self._number = 0  # how often odometry has begun, and the number of the present beginning
        self._left: Left | None = None
        self.left_out = 0
        """How many messages came between two of odometry that went on, and were none of it."""
        self._run = 0  # messages since odometry has begun or returned
        self._runs: deque[tuple[int, int]] = deque(maxlen=MOST_RUNS)  # those before: their ends, and their messages
        self._trusted = 1  # the number of the last beginning that was followed by enough messages
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
        twist = message.twist.twist.linear
        speed = math.hypot(twist.x, twist.y)
        speed = speed if math.isfinite(speed) else 0.0
        reading = Reading(stamp, planar, speed, _covariance(message.pose.covariance))
        with self._lock:
            frame = message.header.frame_id
            if frame != self.frame or self._begins_anew(self._poses, reading):
                self._leave(frame, reading)
            self._run += 1
            if self._run >= SETTLED:
                self._trusted = self._number
            self.frame, self.child = frame, message.child_frame_id
            if not self._poses or stamp > self._poses[-1].stamp:
                self._poses.append(reading)
            else:
                insort(self._poses, reading, key=_stamp)
            oldest = self._poses[-1].stamp - int(HISTORY_SECONDS * NANOSECONDS)
            if self._poses[0].stamp < oldest - NANOSECONDS or len(self._poses) > MOST_POSES:
                first = max(bisect_left(self._poses, oldest, key=_stamp), len(self._poses) - MOST_POSES)
                del self._poses[:first]

    def _leave(self, frame: str, reading: Reading) -> None:
        """Begin anew with a message, or go on with the odometry before if the message goes on there."""
        left, present = self._left, Left(self._poses, self.frame, self._number)
        self._left = present
        if left is not None and left.frame == frame and left.readings:
            last = left.readings[-1]
            gone_on = 0 < reading.stamp - last.stamp <= RETURN * NANOSECONDS
            if gone_on and not self._begins_anew(left.readings, reading):
                if self._number != self._trusted:
                    self.left_out += self._run
                self._runs.append((reading.stamp, self._run))
                self._poses, self._number, self._run = left.readings, left.number, 0
                return
        if self._run:
            self._runs.append((reading.stamp, self._run))
        self._beginnings += 1
        self._poses, self._number, self._run = [], self._beginnings, 0

    @property
    def origin(self) -> str:
        """A name for where the odometry began, of 128 characters at most."""
        return f"{self._number} {self.frame}"[:128]

    @property
    def alternates(self) -> bool:
        """Whether messages of two publishers alternate: odometry leaps and returns again and again."""
        with self._lock:
            return self._alternates()

    def _alternates(self) -> bool:
        if len(self._runs) < MOST_RUNS or not self._poses:
            return False
        sides = [sum(count for _, count in list(self._runs)[side::2]) for side in (0, 1)]
        lately = abs(self._poses[-1].stamp - self._runs[0][0]) <= RUNS_WITHIN * NANOSECONDS
        return lately and min(sides) * BY_FAR > max(sides)

    def located(self, stamp: int) -> Located | None:
        """Where the robot was at a moment, in nanoseconds, and by which odometry; None if none is near it."""
        with self._lock:
            reading = self._read(stamp)
            settled = self._number == self._trusted and not self._alternates()
            return None if reading is None else Located(reading.pose, self.origin, settled)

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._poses, self._left, self._trusted = [], None, self._beginnings + 1
            self._runs.clear()
            self.frame = self.child = ""

    def at(self, stamp: int) -> Planar | None:
        """The pose at a moment, in nanoseconds; None if no odometry is near it."""
        with self._lock:
            reading = self._read(stamp)
        return None if reading is None else reading.pose

    @property
    def latest(self) -> tuple[int, Planar | None]:
        """The last stamp in nanoseconds and its pose; 0 and None if there is none."""
        with self._lock:
            return (self._poses[-1].stamp, self._poses[-1].pose) if self._poses else (0, None)

    def odometry(self, stamp: int, camera_yaw: float = 0.0) -> Odometry | None:
        """The odometry to send with a frame of a moment, in nanoseconds; None if none is near it.

        Args:
            camera_yaw: radians by which the camera looks to the left of the robot's front; the heading is that of the
                camera, as headings of a map are.
        """
        with self._lock:
            reading, origin = self._read(stamp), self.origin
        if reading is None:
            return None
        pose = reading.pose
        return Odometry(pose.x, pose.y, math.degrees(pose.yaw + camera_yaw), reading.covariance, origin)

    def _read(self, stamp: int) -> Reading | None:
        """The reading of a moment, between two messages if there is none of it; the caller holds the lock."""
        place = bisect_left(self._poses, stamp, key=_stamp)
        if place == len(self._poses):
            near = self._poses and stamp - self._poses[-1].stamp <= LATEST * NANOSECONDS
            return self._poses[-1] if near else None
        after = self._poses[place]
        if after.stamp == stamp:
            return after
        if place == 0:
            return None
        before = self._poses[place - 1]
        if after.stamp - before.stamp > int(LARGEST_GAP * NANOSECONDS):
            return None
        share = (stamp - before.stamp) / (after.stamp - before.stamp)
        first, second, covariance = before.pose, after.pose, None
        if before.covariance is not None and after.covariance is not None:
            pairs = zip(before.covariance, after.covariance, strict=True)
            covariance = tuple(one + share * (other - one) for one, other in pairs)
        pose = Planar(
            first.x + share * (second.x - first.x),
            first.y + share * (second.y - first.y),
            wrapped(first.yaw + share * wrapped(second.yaw - first.yaw)),
            first.z + share * (second.z - first.z),
        )
        return Reading(stamp, pose, max(before.speed, after.speed), covariance)

    def _begins_anew(self, poses: Sequence[Reading], reading: Reading) -> bool:
        """Whether odometry begins anew with a message: its clock was set back, as by a bag, or its pose has jumped.

        A pose has jumped if it is farther away than the robot can have gone since the message before.
        """
        if not poses:
            return False
        last = poses[-1]
        seconds = (reading.stamp - last.stamp) / NANOSECONDS
        if seconds <= 0:
            return seconds < -CLOCK_JUMP
        gone = self._fastest * seconds
        speeds = [speed for speed in (last.speed, reading.speed) if speed]
        if len(poses) > 1 and (before := poses[-2]).stamp < last.stamp:
            speeds.append(_metres(before, last) * NANOSECONDS / (last.stamp - before.stamp))
        if speeds:
            gone = min(gone, max(speeds) * seconds + GAINED * seconds**2)
        return _metres(last, reading) > AWAY + gone


def _metres(one: Reading, other: Reading) -> float:
    return math.hypot(other.pose.x - one.pose.x, other.pose.y - one.pose.y)


def _stamp(reading: Reading) -> int:
    return reading.stamp


def _covariance(numbers: Sequence[float]) -> Covariance | None:
    """The covariance of x, y and yaw of one of ROS, 6 x 6; None if it cannot be one."""
    flat = [float(numbers[place]) for place in FLAT]
    if not all(abs(number) <= LARGEST_COVARIANCE for number in flat) or min(flat[0], flat[4], flat[8]) < 0:
        return None
    for one, other in ((1, 3), (2, 6), (5, 7)):  # drivers leave out a half, or round
        flat[one] = flat[other] = 0.5 * (flat[one] + flat[other])
    return tuple(flat)
