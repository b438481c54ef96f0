"""Video files: their frames, with the times and the orientation that the container gives."""

from __future__ import annotations

import threading
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from core.errors import InvalidRecording, NotAnImage
from core.recordings.frame import NANOSECONDS, RecordedFrame, make_id
from core.recordings.pictures import png

SUFFIXES = frozenset({".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".ogv", ".ts", ".webm", ".wmv"})

LONGEST_STEM = 112
"""Characters of a file's name in the ids of places, which leave room for the number of a frame."""


class Video:
    """A video file that is decoded forward; to go back, it is opened again."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            InvalidRecording: it cannot be read, or OpenCV knows no way to decode it.
        """
        self.path = path
        self._lock = threading.Lock()
        self._capture = self._opened()
        self._next = 0  # the number of the frame that is grabbed next

    def _opened(self) -> Any:
        try:
            self.path.open("rb").close()
        except OSError as error:
            raise InvalidRecording(f"{self.path} cannot be read: {error.strerror}.") from error
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise InvalidRecording(f"{self.path} is not a video that OpenCV can decode here, or is damaged.")
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        return capture

    def frames(self) -> tuple[list[RecordedFrame], list[str]]:
        """The frames and remarks on them; the whole file is decoded once to learn how many there are, and when.

        The id of a frame is made of the file's name and its number.

        Raises:
            InvalidRecording: there is none.
        """
        announced = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        times = []
        while self._capture.grab():
            times.append(round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1_000_000))
        if not times:
            raise InvalidRecording(f"{self.path} has no frame that can be decoded.")
        self._restart()
        stem, remarks = self.path.stem[:LONGEST_STEM], []
        if len(times) < announced:
            remarks.append(
                f"{self.path.name} announces {announced} frames and ends after {len(times)}, which are taken; it may "
                "be cut short."
            )
        frames = [
            RecordedFrame(
                make_id(f"{stem}-{number:06d}"),
                f"{self.path.name}, frame {number} at {taken / NANOSECONDS:.3f} s",
                partial(self._picture, number),
                nanoseconds=taken,
            )
            for number, taken in enumerate(times)
        ]
        return frames, remarks

    def _restart(self) -> None:
        self._capture.release()
        self._capture, self._next = self._opened(), 0

    def _picture(self, number: int) -> bytes:
        with self._lock:
            if number < self._next - 1:
                self._restart()
            while self._next <= number and self._capture.grab():
                self._next += 1
            there, pixels = self._capture.retrieve() if self._next == number + 1 else (False, None)
        if not there:
            raise NotAnImage("The frame cannot be decoded.")
        return png(np.asarray(pixels))

    def close(self) -> None:
        """Close the file."""
        self._capture.release()
