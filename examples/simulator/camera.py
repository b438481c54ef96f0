"""The robot's camera: what it sees of the walls, by one ray for each column of the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from examples.simulator.world import PIXELS_PER_METRE, WALL_HEIGHT, Array, Hall, Pixels
from placerec_ros.planar import Planar

COLUMNS, ROWS, FOCAL = 320, 240, 200.0
"""Pixels; the centre of the picture is that of the projection."""
MOUNT = Planar(0.2, 0.0, 0.0, 1.2)
"""Where the camera is on the robot; it looks ahead."""
FINER = 2
"""Rays and rows per pixel, each way, over which its colour is the mean."""


@dataclass
class Camera:
    """A camera on one day.

    Args:
        hall: what it is in.
        light: by how much the picture is brighter or darker than the walls.
        noise: standard deviation of each value of the picture.
        seed: of the noise.
    """

    hall: Hall
    light: float = 1.0
    noise: float = 2.0
    seed: int = 0

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed)

    def look(self, robot: Planar) -> Pixels:
        """The picture that the camera takes where the robot is, uint8 [240, 320, 3] in the order BGR."""
        at = robot.then(MOUNT)
        columns = (np.arange(COLUMNS * FINER) + 0.5) / FINER - COLUMNS / 2
        rows = (np.arange(ROWS * FINER) + 0.5) / FINER - ROWS / 2
        cos, sin = np.cos(at.yaw), np.sin(at.yaw)
        aside = -columns / FOCAL  # metres to the left, a metre ahead
        rays = np.stack([cos - sin * aside, sin + cos * aside], axis=1)
        wall, depth, along = _hits(self.hall.walls, np.array([at.x, at.y]), rays)
        height = at.z - rows[:, np.newaxis] / FOCAL * depth  # where each ray meets its wall, [rows, columns]
        seen = self._floor_and_ceiling(at, rays, rows)
        for number, picture in enumerate(self.hall.pictures):
            here = np.flatnonzero(wall == number)
            part = np.ix_(np.arange(len(rows)), here)
            colours = _sampled(picture, along[here] * PIXELS_PER_METRE, (WALL_HEIGHT - height[part]) * PIXELS_PER_METRE)
            seen[part] = np.where(((height[part] >= 0) & (height[part] <= WALL_HEIGHT))[..., None], colours, seen[part])
        pooled = seen.reshape(ROWS, FINER, COLUMNS, FINER, 3).mean(axis=(1, 3))
        noisy = self.light * pooled + self._random.normal(0, self.noise, pooled.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)

    def _floor_and_ceiling(self, at: Planar, rays: Array, rows: Array) -> Array:
        """A picture without walls: a plain ceiling, and a floor of tiles of half a metre."""
        seen = np.full((len(rows), len(rays), 3), 215.0)
        below = np.flatnonzero(rows > 0)
        reach = at.z * FOCAL / rows[below]
        points = np.array([at.x, at.y]) + reach[:, np.newaxis, np.newaxis] * rays
        tiles = np.floor(2 * points).astype(np.int64) % 64
        seen[below] = self.hall.floor[tiles[..., 0], tiles[..., 1]]
        return seen


def _hits(walls: Array, at: Array, rays: Array) -> tuple[Array, Array, Array]:
    """The wall that each ray meets first, how far ahead (m, along the optical axis), and at which metre of the wall."""
    begin, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    length = np.linalg.norm(along, axis=1)
    way = begin - at  # [n, 2]
    cross = rays[:, :1] * along[:, 1] - rays[:, 1:] * along[:, 0]  # [rays, n]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (way[:, 0] * along[:, 1] - way[:, 1] * along[:, 0]) / cross
        share = (way[:, 0] * rays[:, 1:] - way[:, 1] * rays[:, :1]) / cross
    depth = np.where((depth > 1e-6) & (share >= 0) & (share <= 1), depth, np.inf)
    first = depth.argmin(axis=1)
    which = np.arange(len(rays)), first
    return first, depth[which], share[which] * length[first]


def _sampled(picture: Pixels, across: Array, down: Array) -> Array:
    """A picture between its pixels: [rows, columns, 3] at columns ``across``, [columns], and rows ``down``."""
    height, width = picture.shape[:2]
    x, y = np.clip(across - 0.5, 0, width - 1), np.clip(down - 0.5, 0, height - 1)
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    dx, dy = (x - left)[np.newaxis, :, np.newaxis], (y - top)[..., np.newaxis]
    upper = picture[top, left] * (1 - dx) + picture[top, right] * dx
    lower = picture[bottom, left] * (1 - dx) + picture[bottom, right] * dx
    return np.asarray(upper * (1 - dy) + lower * dy, np.float64)
