"""Disturbances that make a frame harder to recognize, in steps: the camera moved, it is dark, a truck is in the way.

Each takes a frame (H x W x 3 uint8 BGR), a level and a generator, and returns a frame of the same
size; level 0 of each changes nothing.  One generator seed gives one disturbance: noise at a higher
level is the same noise, stronger.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from core.frames.preprocessing import Pixels

Apply = Callable[[Pixels, float, np.random.Generator], Pixels]

GREY = 128
"""Grey value of an occluding box."""


@dataclass(frozen=True)
class Disturbance:
    """One kind of change and the levels at which it is applied; the first changes nothing.

    unit: of the levels, in words.
    """

    name: str
    unit: str
    levels: tuple[float, ...]
    apply: Apply

    def changed(self, pixels: Pixels, level: float, seed: int, number: int) -> Pixels:
        """The frame at a level.

        Args:
            seed: of the run.
            number: of the frame in its traverse; each has its own noise and its own box.
        """
        if level == self.levels[0]:
            return pixels
        generator = np.random.default_rng([seed, number, *self.name.encode()])
        return self.apply(pixels, level, generator)


def lateral_shift(pixels: Pixels, level: float, _: np.random.Generator) -> Pixels:
    """The scene moves sideways by ``level`` percent of the width; the part that comes into view mirrors the edge."""
    height, width = pixels.shape[:2]
    move = np.array([[1, 0, level / 100 * width], [0, 1, 0]], np.float32)
    moved = cv2.warpAffine(pixels, move, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(moved, np.uint8)


def scale(pixels: Pixels, level: float, _: np.random.Generator) -> Pixels:
    """The scene comes nearer: the middle of the frame, ``level`` times enlarged."""
    height, width = pixels.shape[:2]
    move = np.array([[level, 0, (1 - level) * (width - 1) / 2], [0, level, (1 - level) * (height - 1) / 2]], np.float32)
    return np.asarray(cv2.warpAffine(pixels, move, (width, height), flags=cv2.INTER_LINEAR), np.uint8)


def darkness(pixels: Pixels, level: float, _: np.random.Generator) -> Pixels:
    """``level`` percent of the light is gone; the rest is rounded to 8 bits."""
    return np.round(pixels * np.float32(1 - level / 100)).astype(np.uint8)


def noise(pixels: Pixels, level: float, generator: np.random.Generator) -> Pixels:
    """Gaussian noise with a standard deviation of ``level`` grey values in each channel of each pixel."""
    noisy = pixels + np.float32(level) * generator.standard_normal(pixels.shape, np.float32)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def blur(pixels: Pixels, level: float, _: np.random.Generator) -> Pixels:
    """Gaussian blur with a standard deviation of ``level`` percent of the width."""
    return np.asarray(cv2.GaussianBlur(pixels, (0, 0), level / 100 * pixels.shape[1]), np.uint8)


def occlusion(pixels: Pixels, level: float, generator: np.random.Generator) -> Pixels:
    """A grey box of the frame's shape covers ``level`` percent of its area, somewhere."""
    height, width = pixels.shape[:2]
    side = np.sqrt(level / 100)
    tall, wide = round(height * side), round(width * side)
    # The same fraction of the free way at every level: a larger box grows from about the same spot.
    down, across = generator.random(2)
    top, left = round(down * (height - tall)), round(across * (width - wide))
    covered = pixels.copy()
    covered[top : top + tall, left : left + wide] = GREY
    return covered


DISTURBANCES: tuple[Disturbance, ...] = (
    Disturbance("lateral shift", "% of the width", (0, 5, 10, 20, 30), lateral_shift),
    Disturbance("scale", "times", (1, 1.1, 1.25, 1.5, 2), scale),
    Disturbance("darkness", "% of the light gone", (0, 50, 75, 90, 95), darkness),
    Disturbance("noise", "grey values of standard deviation", (0, 10, 20, 40, 60), noise),
    Disturbance("blur", "% of the width of standard deviation", (0, 0.5, 1, 2, 4), blur),
    Disturbance("occlusion", "% of the area", (0, 10, 25, 40, 60), occlusion),
)
