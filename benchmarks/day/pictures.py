"""Disturbances of the pictures of a camera: noise, people, hands, dirt, light, and how the camera is mounted."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels

Random: TypeAlias = np.random.Generator
Look: TypeAlias = Callable[[Pixels, Random, int], Pixels]
"""How the n-th picture of a stretch comes out; pixels are uint8 [H, W, 3], BGR."""

QUALITY = 90
NOISE = 3.0
"""Standard deviation of a camera's noise, in grey levels."""

NEARER = 0.04
"""By how much of its width a picture grows from one frame of a walk to the next, where one in between is drawn."""

UPRIGHT, UPSIDE_DOWN, ON_ITS_SIDE = 1, 3, 6
"""Orientations of EXIF: as the pixels lie, to be turned by 180 degrees, to be turned by 90 degrees clockwise."""


def _clipped(values: NDArray[np.floating]) -> Pixels:
    return np.clip(values, 0, 255).astype(np.uint8)


def another_look(pixels: Pixels, random: Random, nearer: float = 0.0) -> Pixels:
    """The same view a moment later: noise, a little more or less light, and ``nearer`` frames of a walk on or back.

    Args:
        nearer: from -0.5 to 0.5 frames.
    """
    height, width = pixels.shape[:2]
    zoom = 1 + NEARER / 2 + NEARER * nearer if nearer else 1.0
    turned = cv2.warpAffine(
        pixels, cv2.getRotationMatrix2D((width / 2, height / 2), 0, zoom), (width, height), flags=cv2.INTER_CUBIC
    )
    return _clipped(turned * random.uniform(0.97, 1.03) + random.normal(0, NOISE, pixels.shape))


def people(pixels: Pixels, random: Random, number: int) -> Pixels:
    """Two people who walk past, one to the right and one to the left, before whatever the camera sees."""
    height, width = pixels.shape[:2]
    shown = pixels.copy()
    for one, (pace, size, colour) in enumerate(((0.13, 0.80, (58, 44, 40)), (-0.17, 0.62, (70, 92, 120)))):
        tall = int(size * height)
        across = int(((0.2 + 0.5 * one + pace * number) % 1.3 - 0.15) * width)
        head, top = tall // 8, height - tall
        cv2.circle(shown, (across, top + head), head, (120, 140, 180), -1)
        cv2.ellipse(shown, (across, top + tall // 2), (tall // 6, int(0.28 * tall)), 0, 0, 360, colour, -1)
        stride = int(0.1 * tall * np.sin(1.7 * number + one))
        for leg in (-1, 1):
            foot = (across + leg * stride, height)
            cv2.line(shown, (across, top + int(0.7 * tall)), foot, colour, max(2, tall // 12))
    return _clipped(shown + random.normal(0, NOISE, shown.shape))


def hand(pixels: Pixels, random: Random, _number: int) -> Pixels:
    """A hand on the lens: skin out of focus, and some light between the fingers."""
    height, width = pixels.shape[:2]
    light = cv2.GaussianBlur(random.normal(0, 1, (height, width)), (0, 0), width / 6)
    skin = np.array([52.0, 64.0, 104.0]) * (1 + 0.25 * light / max(float(np.abs(light).max()), 1e-6))[..., None]
    return _clipped(skin + random.normal(0, NOISE, pixels.shape))


def dirty(pixels: Pixels, _random: Random, _number: int) -> Pixels:
    """The left half of the lens is smeared and speckled; the dirt stays where it is."""
    height, width = pixels.shape[:2]
    smeared = cv2.GaussianBlur(pixels, (0, 0), width / 24) * 0.6 + 70
    spots = np.random.default_rng(11)
    for _ in range(12):
        centre = (int(spots.integers(width // 2)), int(spots.integers(height)))
        cv2.circle(smeared, centre, int(spots.integers(2, max(3, width // 30))), (60, 70, 80), -1)
    share = np.clip((0.55 * width - np.arange(width)) / (0.1 * width), 0, 1)[None, :, None]
    return _clipped(share * smeared + (1 - share) * pixels)


def exposure(pixels: Pixels, _random: Random, number: int) -> Pixels:
    """The gain jumps from frame to frame: too dark, right, too bright."""
    return _clipped(pixels * (0.35, 1.0, 1.9, 0.6)[number % 4])


def cut(across: float, down: float) -> Look:
    """A camera that sees so much of the width and height; the file has the pixels that are left."""

    def look(pixels: Pixels, _random: Random, _number: int) -> Pixels:
        height, width = pixels.shape[:2]
        top, left = round((1 - down) * height / 2), round((1 - across) * width / 2)
        return np.ascontiguousarray(pixels[top : height - top, left : width - left])

    return look


def portrait(pixels: Pixels, random: Random, number: int) -> Pixels:
    """A camera held upright: all of the height, and 9 / 16 of that across."""
    height, width = pixels.shape[:2]
    return cut(height * 9 / 16 / width, 1.0)(pixels, random, number)


def narrower(pixels: Pixels, random: Random, number: int) -> Pixels:
    """A camera of a longer lens: 70 % of the view, in a file of the same size."""
    height, width = pixels.shape[:2]
    middle = cut(0.7, 0.7)(pixels, random, number)
    return np.asarray(cv2.resize(middle, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def wider(pixels: Pixels, _random: Random, _number: int) -> Pixels:
    """A camera of a shorter lens: the view fills 70 % of the file, and around it is more of the same."""
    height, width = pixels.shape[:2]
    small = cv2.resize(pixels, (round(0.7 * width), round(0.7 * height)), interpolation=cv2.INTER_AREA)
    top, left = (height - small.shape[0]) // 2, (width - small.shape[1]) // 2
    edges = top, height - small.shape[0] - top, left, width - small.shape[1] - left
    return np.asarray(cv2.copyMakeBorder(small, *edges, cv2.BORDER_REFLECT), np.uint8)


def upside_down(pixels: Pixels, _random: Random, _number: int) -> Pixels:
    """A camera mounted upside down."""
    return np.ascontiguousarray(pixels[::-1, ::-1])


def on_its_side(pixels: Pixels, _random: Random, _number: int) -> Pixels:
    """A camera turned by 90 degrees clockwise: its view is turned counter-clockwise in its file."""
    return np.ascontiguousarray(np.rot90(pixels))


def file(pixels: Pixels, orientation: int = UPRIGHT) -> bytes:
    """A JPEG file, which says by EXIF how its pixels are to be turned if they do not lie upright."""
    data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
    if orientation == UPRIGHT:
        return data
    entry = struct.pack(">HHIHH", 0x0112, 3, 1, orientation, 0)
    block = b"Exif\0\0MM\0*" + struct.pack(">IH", 8, 1) + entry + struct.pack(">I", 0)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + data[2:]
