"""Pictures of two frames side by side with lines and boxes drawn over them, and a store of the latest pictures."""

from __future__ import annotations

import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from core.frames.images import encode_png
from core.frames.preprocessing import Pixels
from service.errors.faults import UnknownExplanation
from service.queries.given_answers import MapKey

HEIGHT = 360
"""The height of each frame in a picture, in pixels."""

WIDEST = 960
"""The largest width of each frame in a picture, in pixels; a panorama is scaled to this width and is lower."""

GAP = 8
"""The gap between the frames, in pixels."""

MOST = 64
"""How many pictures are stored."""

SECONDS = 600.0
"""For how long a picture can be fetched."""


@dataclass(frozen=True)
class DrawnLine:
    """A line from a point of the left frame to one of the right one, (x, y) in shares of width and height.

    weight: 0 … 1; a heavier line is thicker.
    """

    left: tuple[float, float]
    right: tuple[float, float]
    weight: float


@dataclass(frozen=True)
class DrawnOutline:
    """A box (left, top, right, bottom) in shares of width and height.

    weight: 0 … 1; a heavier outline is thicker.
    """

    box: tuple[float, float, float, float]
    weight: float


def side_by_side(
    left: Pixels,
    right: Pixels,
    lines: Sequence[DrawnLine],
    outlines: tuple[Sequence[DrawnOutline], Sequence[DrawnOutline]],
) -> bytes:
    """A PNG of two frames with lines and outlines; heavier ones are thicker and drawn over the others.

    Args:
        left, right: uint8 [H, W, 3], BGR.
        outlines: the boxes in the left frame, and those in the right one.
    """
    frames = [scaled(left), scaled(right)]
    height = max(len(frame) for frame in frames)
    starts = [0, frames[0].shape[1] + GAP]
    canvas = np.full((height, starts[1] + frames[1].shape[1], 3), 32, np.uint8)
    for frame, start in zip(frames, starts, strict=True):
        canvas[: len(frame), start : start + frame.shape[1]] = frame
    for frame, start, boxes in zip(frames, starts, outlines, strict=True):
        for outline in sorted(boxes, key=lambda one: one.weight):
            (x0, y0), (x1, y1) = (_point(outline.box[i : i + 2], frame, start) for i in (0, 2))
            cv2.rectangle(canvas, (x0, y0), (x1 - 1, y1 - 1), (255, 255, 255), 1 + round(outline.weight), cv2.LINE_AA)
    for line in sorted(lines, key=lambda one: one.weight):
        ends = _point(line.left, frames[0], starts[0]), _point(line.right, frames[1], starts[1])
        # A colour for each height in the left frame, so that crossing lines can be distinguished.
        colour = _colour(line.left[1])
        cv2.line(canvas, *ends, colour, 1 + round(line.weight), cv2.LINE_AA)
        for end in ends:
            cv2.circle(canvas, end, 3, colour, -1, cv2.LINE_AA)
    return encode_png(canvas)


def scaled(frame: Pixels) -> Pixels:
    """A frame scaled to the size in which it is drawn, uint8 [h, w, 3] with h ≤ ``HEIGHT`` and w ≤ ``WIDEST``."""
    height, width = frame.shape[:2]
    factor = min(HEIGHT / height, WIDEST / width)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), np.uint8)


def _point(share: Sequence[float], frame: Pixels, start: int) -> tuple[int, int]:
    height, width = frame.shape[:2]
    return start + round(share[0] * width), round(share[1] * height)


def _colour(share: float) -> tuple[int, int, int]:
    value = np.full((1, 1), min(255, round(255 * share)), np.uint8)
    blue, green, red = cv2.applyColorMap(value, cv2.COLORMAP_TURBO)[0, 0].tolist()
    return blue, green, red


class ExplanationPictures:
    """The pictures of the latest explanations, in memory.  Thread-safe."""

    def __init__(self) -> None:
        self._stored: OrderedDict[tuple[MapKey, str], tuple[float, bytes]] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, key: MapKey, picture: bytes) -> str:
        """Store a PNG for ``SECONDS``, or until its map is deleted; returns the name by which it can be fetched."""
        name = secrets.token_urlsafe(12)
        with self._lock:
            self._stored[key, name] = (time.monotonic() + SECONDS, picture)
            while len(self._stored) > MOST:
                self._stored.popitem(last=False)
        return name

    def fetch(self, key: MapKey, name: str) -> bytes:
        """The PNG of a name.

        Raises:
            UnknownExplanation: there is no such picture, or it is not stored any more.
        """
        with self._lock:
            until, picture = self._stored.get((key, name), (0.0, b""))
        if time.monotonic() > until:
            raise UnknownExplanation(
                f"There is no picture {name[:40]!r}; the latest {MOST} are stored for {SECONDS / 60:.0f} minutes."
            )
        return picture

    def forget(self, key: MapKey) -> None:
        """Drop the pictures of a map."""
        with self._lock:
            for one in [one for one in self._stored if one[0] == key]:
                del self._stored[one]
