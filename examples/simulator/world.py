"""The world: a corridor around a block, with pictures on its walls, and a robot of two driven wheels in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placerec_ros.planar import Planar, wrapped

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]  # [H, W, 3], BGR

LENGTH, WIDTH, AISLE = 36.0, 18.0, 3.0
"""Metres of the rectangle along whose sides the corridor's middle leads, from (0, 0) on, and across the corridor."""
WALL_HEIGHT = 2.6
PIXELS_PER_METRE = 50
RADIUS = 0.3
"""Metres from the robot's centre to its rim."""
DRIFT = 0.05
"""The lasting error of odometry's steps and turns, up or down, and the standard deviation of another, as shares."""
WANDERING = math.radians(0.3)
"""Radians by which odometry's heading wanders along a metre."""


def _rectangle(margin: float) -> Array:
    """The four sides of a rectangle so many metres inside that of the corridor's middle, [4, 2, 2]."""
    left, right, bottom, top = margin, LENGTH - margin, margin, WIDTH - margin
    corners = np.array([(left, bottom), (right, bottom), (right, top), (left, top)])
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def _drawn(random: np.random.Generator, metres: float) -> Pixels:
    """A wall with something else to see at every metre: panels, frames and discs, uint8 [H, W, 3]."""
    height, width = round(WALL_HEIGHT * PIXELS_PER_METRE), round(metres * PIXELS_PER_METRE)
    wall = np.empty((height, width, 3), np.float64)
    wall[:] = random.integers(120, 200, 3)
    for _ in range(round(14 * metres)):
        x, y = random.integers(0, width), random.integers(0, height)
        half, tall = random.integers(4, 45), random.integers(4, 45)
        colour = random.integers(0, 256, 3)
        reach = max(half, tall)
        top, left = max(y - reach, 0), max(x - reach, 0)
        down, across = np.ogrid[top : min(y + reach + 1, height), left : min(x + reach + 1, width)]
        if random.random() < 0.6:
            part = (abs(across - x) <= half) & (abs(down - y) <= tall)
            if random.random() < 0.3:
                part &= (abs(across - x) > half - 4) | (abs(down - y) > tall - 4)
        else:
            part = np.hypot(across - x, down - y) <= half / 1.5
        wall[top : top + part.shape[0], left : left + part.shape[1]][part] = colour
    return np.clip(wall, 0, 255).astype(np.uint8)


class Hall:
    """The corridor: where its walls are, and how they look.

    walls: [n, 2, 2], metres, from where to where each leads.
    pictures: of each wall, uint8 [H, W, 3] in the order BGR, from its beginning to its end.
    """

    def __init__(self, seed: int = 5) -> None:
        random = np.random.default_rng(seed)
        self.walls = np.concatenate([_rectangle(-AISLE / 2), _rectangle(AISLE / 2)])
        lengths = np.linalg.norm(self.walls[:, 1] - self.walls[:, 0], axis=1)
        self.pictures = [_drawn(random, float(length)) for length in lengths]
        self.floor = random.integers(70, 110, (64, 64, 1))

    def clearance(self, x: float, y: float) -> float:
        """Metres from a point to the nearest wall."""
        begin, along = self.walls[:, 0], self.walls[:, 1] - self.walls[:, 0]
        share = (([x, y] - begin) * along).sum(axis=1) / np.square(along).sum(axis=1)
        nearest = begin + np.clip(share, 0, 1)[:, np.newaxis] * along
        return float(np.hypot(*(nearest - [x, y]).T).min())


@dataclass
class Robot:
    """A robot of two driven wheels: where it is, and where its odometry believes it to be.

    Args:
        true: in the world.
        odom: by odometry, which begins somewhere else.
        seed: of the errors of odometry; None: it has none.
    """

    hall: Hall
    true: Planar
    odom: Planar
    seed: int | None = None
    bumps: int = 0
    """Steps in which a wall was in the way."""

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed or 0)
        self._longer, self._more = 1 + DRIFT * self._random.choice((-1, 1), size=2)

    def step(self, speed: float, turn: float, seconds: float) -> None:
        """Drive: metres a second ahead, and radians a second to the left."""
        length, angle = speed * seconds, turn * seconds
        moved = self.true.then(_arc(length, angle))
        if self.hall.clearance(moved.x, moved.y) >= RADIUS:
            self.true = moved
        else:
            self.bumps += 1
        if self.seed is not None:
            noise = self._random.normal(size=3)
            length *= self._longer + DRIFT * noise[0]
            angle = angle * (self._more + DRIFT * noise[1]) + WANDERING * math.sqrt(abs(speed * seconds)) * noise[2]
        self.odom = self.odom.then(_arc(length, angle))

    def carry(self, to: Planar) -> None:
        """Set it down somewhere else; its wheels, and so its odometry, know nothing of that."""
        self.true = to


def _arc(length: float, angle: float) -> Planar:
    """The motion along an arc of a circle, in the frame of its beginning."""
    if abs(angle) < 1e-9:
        return Planar(length, 0.0, angle)
    radius = length / angle
    return Planar(radius * math.sin(angle), radius * (1 - math.cos(angle)), wrapped(angle))
