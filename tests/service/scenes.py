"""Pictures made in code: corridors of rectangles, text and noise, from the same spot under another light."""

from __future__ import annotations

from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels

WORDS = ("EXIT", "LAB 2", "NORTH", "MUSEUM", "42", "STAIRS", "CAFE", "WAREHOUSE")


def scene(seed: int, width: int = 320, height: int = 240) -> Pixels:
    """One place: the same seed always shows the same; other seeds show something else."""
    random = np.random.default_rng(seed)
    top, bottom = random.integers(40, 216, (2, 3))
    ramp = np.linspace(0, 1, height)[:, None, None]
    picture = ((1 - ramp) * top + ramp * bottom + np.zeros((height, width, 3))).astype(np.uint8)
    for _ in range(28):
        x, y = int(random.integers(0, width)), int(random.integers(0, height))
        w, h = int(random.integers(8, width // 3)), int(random.integers(8, height // 2))
        colour = tuple(int(c) for c in random.integers(0, 256, 3))
        if random.random() < 0.6:
            cv2.rectangle(picture, (x, y), (x + w, y + h), colour, -1 if random.random() < 0.7 else 3)
        else:
            cv2.circle(picture, (x, y), w // 2, colour, -1 if random.random() < 0.5 else 4)
    word = WORDS[seed % len(WORDS)]
    cv2.putText(picture, word, (width // 8, height // 2), cv2.FONT_HERSHEY_DUPLEX, 1.5, (245, 245, 245), 3)
    noise = random.normal(0, 4, picture.shape)
    return np.asarray(np.clip(picture + noise, 0, 255), np.uint8)


def stranger(seed: int) -> Pixels:
    """A place that no other seed shows: mirrored, for scenes share eight words, which fit one another geometrically."""
    return np.ascontiguousarray(scene(seed)[:, ::-1])


def seen_again(pixels: Pixels, seed: int = 0) -> Pixels:
    """The same place another day: a little shifted, darker, noisier."""
    random = np.random.default_rng(seed)
    height, width = pixels.shape[:2]
    shift = np.array([[1.02, 0, -4], [0, 1.02, -2]], np.float32)
    moved = cv2.warpAffine(pixels, shift, (width, height), borderMode=cv2.BORDER_REFLECT)
    return np.asarray(np.clip(moved * 0.9 + 6 + random.normal(0, 5, moved.shape), 0, 255), np.uint8)


def blank(width: int = 64, height: int = 64) -> Pixels:
    """Nothing but black."""
    return np.zeros((height, width, 3), np.uint8)


def encoded(pixels: NDArray[Any], extension: str = ".jpg", quality: int = 90) -> bytes:
    """The pixels as the bytes of a file."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if extension == ".jpg" else []
    done, data = cv2.imencode(extension, pixels, options)
    assert done
    return bytes(data)


@cache
def jpeg(seed: int, width: int = 320, height: int = 240) -> bytes:
    """A scene as a JPEG file."""
    return encoded(scene(seed, width, height))
