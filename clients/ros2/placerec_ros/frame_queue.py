"""The queue between the camera and the service: it is short, and the oldest frame gives way to the newest.

Frames of several cameras of one moment are put together before it, where they are asked together.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any


@dataclass(frozen=True, eq=False)
class Frame:
    """A message with a picture.

    number: counts the messages of the node, also those that were dropped, so that the service learns of gaps.
    stamp: nanoseconds of the message's own clock; 0 if the message has none.
    message: ``sensor_msgs/CompressedImage`` or ``sensor_msgs/Image``.
    arrived: when it arrived, in seconds of ``time.monotonic``.
    camera: the name of its camera among several; empty for the only one.
    beside: frames that other cameras of a rig took at the same moment, and that are asked together with it.
    """

    number: int
    stamp: int
    message: Any
    arrived: float = field(default_factory=time.monotonic)
    camera: str = ""
    beside: tuple[Frame, ...] = ()

    @property
    def moment(self) -> tuple[Frame, ...]:
        """All frames of the moment, this one first."""
        return (replace(self, beside=()), *self.beside)


class Moments:
    """Frames of the cameras of a rig, put together by their stamps; one thread uses it.

    A moment is complete with a frame of each camera.  It ends without the rest when a frame of a later one comes: a
    camera may be covered, slow or broken, and the others see all the same.

    Args:
        cameras: their names.
        tolerance: nanoseconds by which the stamps of one moment may differ.
    """

    def __init__(self, cameras: Collection[str], tolerance: int) -> None:
        self._cameras, self._tolerance = frozenset(cameras), tolerance
        self._waiting: list[Frame] = []

    def add(self, frame: Frame) -> list[Frame]:
        """Take in a frame; those of the moments that are over by it, each with the others beside the first."""
        over: list[Frame] = []
        if self._waiting and not self._is_alike(frame):
            over.append(self._ended())
        self._waiting.append(frame)
        if {one.camera for one in self._waiting} == self._cameras:
            over.append(self._ended())
        return over

    def clear(self) -> None:
        """Forget the frames that wait for others."""
        self._waiting = []

    def _is_alike(self, frame: Frame) -> bool:
        """Whether a frame is of the moment for which others wait."""
        taken = [one.camera for one in self._waiting]
        apart = max(abs(frame.stamp - one.stamp) for one in self._waiting)
        return frame.camera not in taken and apart <= self._tolerance

    def _ended(self) -> Frame:
        first, *others = self._waiting
        self._waiting = []
        return replace(first, beside=tuple(others))


class FrameQueue:
    """A bounded queue of frames that several threads may use.

    Args:
        length: most frames of each camera that wait.
    """

    def __init__(self, length: int) -> None:
        self._length = length
        self._frames: deque[Frame] = deque()
        self._lock = threading.Lock()
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """How many frames gave way to newer ones, or were too old when their turn came."""
        return self._dropped

    def put(self, frame: Frame) -> None:
        """Add a frame; the oldest of its camera is dropped if as many of it wait as may."""
        with self._lock:
            alike = [one for one in self._frames if one.camera == frame.camera]
            if len(alike) >= self._length:
                self._frames.remove(alike[0])
                self._dropped += 1
            self._frames.append(frame)

    def take(self, oldest: float) -> Frame | None:
        """The next frame that arrived at ``oldest`` or later, in seconds of ``time.monotonic``; None if none waits."""
        with self._lock:
            while self._frames:
                frame = self._frames.popleft()
                if frame.arrived >= oldest:
                    return frame
                self._dropped += 1
            return None

    def clear(self) -> None:
        """Forget the frames that wait; they do not count as dropped."""
        with self._lock:
            self._frames.clear()
