"""A street with two bends between walls of photographs, so that poses are known exactly where a map turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.geometry.pose import OPTICAL, PosedTraverse, pinhole, rotation
from core.frames.preprocessing import Pixels
from lab.training.views.augmentation import augment

Array = NDArray[np.float64]
SIZE = (320, 240)
CAMERA = pinhole(*SIZE, 70)
STRETCHES = ((25, 0), (16, 90), (20, 0), (14, -90), (20, 0))
"""Metres, and degrees by which the street turns to the left on them."""
HEIGHT, EYE, SIGHT, PANEL = 7.0, 1.5, 200.0, 256
"""Metres: of the walls, of the camera and of what is seen; and pixels of a wall's picture along either side."""


@dataclass(frozen=True)
class Street:
    """Upright walls, and a ground that repeats every 8 m.

    starts, ends: metres, float64 [w, 2].
    pictures: of the walls and, last, of the ground, uint8 [w + 1, PANEL, PANEL, 3].
    """

    starts: Array
    ends: Array
    pictures: NDArray[np.uint8]

    def seen(self, pose: Array, tilt: Array) -> Pixels:
        """The picture of a camera at x, y and a heading in degrees, tilted by degrees; uint8 [240, 320, 3]."""
        attitude = rotation(float(pose[2]), *tilt.tolist())
        columns, rows = np.meshgrid(*((np.arange(2 * side) + 0.5) / 2 - 0.5 for side in SIZE))
        rays = np.stack([columns, rows, np.ones_like(columns)], -1) @ np.linalg.inv(CAMERA.matrix()).T
        x, y, up = np.moveaxis(rays @ (attitude @ OPTICAL).T, -1, 0)
        with np.errstate(divide="ignore"):
            depth = np.where(up < 0, -EYE / up, SIGHT)
        which = np.where(depth < SIGHT, len(self.starts), -1)
        depth = np.minimum(depth, SIGHT)
        across = (pose[0] + depth * x) % 8 / 8
        down = (pose[1] + depth * y) % 8 / 8
        for wall, (start, end) in enumerate(zip(self.starts - pose[:2], self.ends - pose[:2], strict=True)):
            if max(start @ attitude[:2, 0], end @ attitude[:2, 0]) < 0:
                continue
            along = end - start
            crossed = x * along[1] - y * along[0]
            crossed = np.where(np.abs(crossed) < 1e-9, 1e-9, crossed)
            away, share = (start[0] * along[1] - start[1] * along[0]) / crossed, (start[0] * y - start[1] * x) / crossed
            height = EYE + away * up
            hit = (away > 0.05) & (away < depth) & (share >= 0) & (share <= 1) & (height >= 0) & (height < HEIGHT)
            depth[hit], which[hit], across[hit], down[hit] = away[hit], wall, share[hit], 1 - height[hit] / HEIGHT
        picture = np.full((*which.shape, 3), (235, 225, 210), np.uint8)
        right, below = (np.asarray(part * (PANEL - 1), np.float32) for part in (across, down))
        for wall in np.unique(which[which >= 0]):
            drawn = cv2.remap(self.pictures[wall], right, below, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            picture[which == wall] = drawn[which == wall]
        return np.asarray(cv2.resize(picture, SIZE, interpolation=cv2.INTER_AREA), np.uint8)


def middle() -> Array:
    """The middle of the street every half metre: x, y and the heading in degrees, float64 [n, 3]."""
    turns = np.concatenate([np.full(2 * length, turn / (2 * length)) for length, turn in STRETCHES])
    headings = np.append(0.0, np.cumsum(turns))
    steps = 0.5 * np.column_stack([np.cos(np.radians(headings[1:])), np.sin(np.radians(headings[1:]))])
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), headings])


def street(pictures: Sequence[Pixels], random: np.random.Generator) -> Street:
    """Walls with random photographs, 4.5 to 6.5 m aside of the middle, in pieces of 7.5 m, and one across each end."""
    line = middle()[::5]
    ahead = [np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0]) for heading in line[[0, -1], 2]]
    before, after = (2 * np.arange(1, count)[:, None] * way for count, way in zip((11, 20), ahead, strict=True))
    line = np.vstack([line[0] - before[::-1], line, line[-1] + after])
    left = np.column_stack([-np.sin(np.radians(line[:, 2])), np.cos(np.radians(line[:, 2]))])
    corners = [(line[at, :2] - 8 * left[at], line[at, :2] + 8 * left[at]) for at in (0, -1)]
    for side in (-1, 1):
        aside = side * np.repeat(random.uniform(4.5, 6.5, len(line)), 3)[: len(line)]
        for at in range(len(line) - 1):
            first, second = line[at, :2] + aside[at] * left[at], line[at + 1, :2] + aside[at] * left[at + 1]
            corners.append((first, second))
            if aside[at + 1] != aside[at]:
                corners.append((second, line[at + 1, :2] + aside[at + 1] * left[at + 1]))
    starts, ends = (np.array(points) for points in zip(*corners, strict=True))
    drawn = []
    for length in np.linalg.norm(ends - starts, axis=1):
        chosen = cv2.resize(pictures[int(random.integers(len(pictures)))], (PANEL, PANEL))
        width = int(np.clip(PANEL * length / 3.5, 2, PANEL))
        from_column = int(random.integers(0, PANEL - width + 1))
        drawn.append(cv2.resize(chosen[:, from_column : from_column + width], (PANEL, PANEL)))
    ground = cv2.resize(pictures[int(random.integers(len(pictures)))], (PANEL, PANEL)).astype(float)
    drawn.append((100 + 0.3 * (ground - ground.mean())).clip(0, 255).astype(np.uint8))
    return Street(starts, ends, np.stack(drawn))


def street_traverse(pictures: Sequence[Pixels], random: np.random.Generator, asked: int) -> PosedTraverse:
    """Places every metre, and queries half a metre and 6° aside of the street's middle and dimmed."""
    made, line = street(pictures, random), middle()
    places = line[::2] + random.normal(0, (0.1, 0.1, 1.5), line[::2].shape)
    true = line[random.integers(8, len(line) - 8, asked)] + random.normal(0, (0.5, 0.5, 6), (asked, 3))
    frames = [made.seen(pose, random.normal(0, 1, 2)) for pose in places]
    queries = [augment(made.seen(pose, random.normal(0, 1, 2)), random) for pose in true]
    return PosedTraverse(frames, places, queries, true, CAMERA)
