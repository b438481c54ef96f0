"""Conditions in which a robot finds a walk again: nights, fog, and things that stand about for a season; drawn.

Each is drawn anew for every run, and is the same for all frames of a run: one light, one weather, and things that stay
where they are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import cv2
import numpy as np

from benchmarks.day.pictures import NOISE, Random, another_look
from core.frames.preprocessing import Pixels

Condition: TypeAlias = Callable[[Pixels, int, int], Pixels]
"""How a place looks: its picture by day, uint8 [H, W, 3], BGR; the number of the place; and that of the run."""


def _generator(*numbers: int) -> Random:
    return np.random.default_rng(numbers)


def _finished(pixels: np.ndarray, random: Random, noise: float = NOISE) -> Pixels:
    return np.clip(pixels + random.normal(0, noise, pixels.shape), 0, 255).astype(np.uint8)


def _cloud(shape: tuple[int, ...], random: Random, width: float) -> np.ndarray:
    """Smooth noise, float64 [H, W], of mean 0 and a largest value of 1."""
    found = cv2.GaussianBlur(random.normal(0, 1, shape[:2]), (0, 0), width)
    return found / max(float(np.abs(found).max()), 1e-9)


def day(pixels: Pixels, place: int, run: int) -> Pixels:
    """The same light, a moment later and a little to the side."""
    return another_look(pixels, _generator(1, run, place))


def night(pixels: Pixels, place: int, run: int) -> Pixels:
    """Little light, much noise, and two lamps in each view, which stay there all year and light up what is near."""
    lamps, random = _generator(2, place), _generator(3, run, place)
    height, width = pixels.shape[:2]
    y, x = np.mgrid[:height, :width]
    light = np.full((height, width), 0.10 + 0.04 * _generator(4, run).random())
    for _ in range(2):
        across, down = lamps.random() * width, 0.45 * lamps.random() * height
        apart = np.hypot(x - across, y - down) / width
        light += 0.35 * np.exp(-((apart / 0.18) ** 2)) + 1.2 * np.exp(-((apart / 0.03) ** 2))
    tinted = pixels.astype(np.float64) ** 1.25 / 255**0.25 * np.array([0.75, 0.95, 1.1])
    return _finished(tinted * light[..., None] + 25 * (light[..., None] > 1), random, 6.0)


def fog(pixels: Pixels, place: int, run: int) -> Pixels:
    """Little contrast, blurred, and paler towards the horizon."""
    random, weather = _generator(5, run, place), _generator(6, run)
    height, width = pixels.shape[:2]
    depth = 1 - np.abs(np.linspace(-1, 1, height))[:, None]  # most in the middle, where the view is deepest
    share = np.clip(
        0.45 + 0.1 * weather.random() + 0.35 * depth + 0.1 * _cloud(pixels.shape, random, width / 8), 0, 0.92
    )
    blurred = cv2.GaussianBlur(pixels, (0, 0), width / 120).astype(np.float64)
    return _finished(blurred * (1 - share[..., None]) + 200 * share[..., None], random)


def clutter(pixels: Pixels, place: int, run: int) -> Pixels:
    """Crates and vans stand about: they hide a third of each view, and stay for a season of four runs."""
    season, random = _generator(7, run // 4, place // 2), _generator(8, run, place)
    height, width = pixels.shape[:2]
    shown = another_look(pixels, random)
    for _ in range(3):
        wide, tall = (
            int(size * share) for size, share in zip((width, height), season.uniform(0.25, 0.42, 2), strict=True)
        )
        left, top = int(season.integers(0, width - wide)), height - tall - int(season.integers(0, height // 3))
        colour = season.uniform(30, 200, 3)
        block = np.full((tall, wide, 3), colour) * (1 + 0.25 * _cloud((tall, wide), season, wide / 6))[..., None]
        for stripe in range(1, 4):
            cv2.line(
                block, (0, stripe * tall // 4), (wide, stripe * tall // 4), (0.6 * colour).tolist(), max(1, tall // 20)
            )
        shown[top : top + tall, left : left + wide] = np.clip(block, 0, 255).astype(np.uint8)
    return shown


CONDITIONS: dict[str, Condition] = {"day": day, "night": night, "fog": fog, "clutter": clutter}
