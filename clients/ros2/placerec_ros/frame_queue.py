"""The queue between the camera and the service: it is short, and the oldest frame gives way to the newest."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Frame:
    """A message with a picture.

    number: counts the messages of the node, also those that were dropped, so that the service learns of gaps.
    stamp: nanoseconds of the message's own clock; 0 if the message has none.
    message: ``sensor_msgs/CompressedImage`` or ``sensor_msgs/Image``.
    arrived: when it arrived, in seconds of ``time.monotonic``.
    """

    number: int
    stamp: int
    message: Any
    arrived: float = field(default_factory=time.monotonic)


class FrameQueue:
    """A bounded queue of frames that several threads may use.

    Args:
        length: most frames that wait.
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
        """Add a frame; the oldest is dropped if the queue is full."""
        with self._lock:
            if len(self._frames) >= self._length:
                self._frames.popleft()
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
