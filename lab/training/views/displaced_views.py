"""Pairs of displaced views of one scene, and which cells of the two show the same spot.

The second view is moved, turned, scaled and bent a little and nearly always disturbed as for the distillation; of the
fixed cameras of day_night the first view is by day and the second by night.  What follows from how the views were cut
needs no match of features, so that also cells answer each other that no matcher would find by night.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.training.photographs import DAY_NIGHT, Pixels, day_and_night, read, source_weights, split_photographs
from lab.training.views.augmentation import augment

CAMERA_SHARE = 0.08
"""How many of the pairs are a day and a night of a fixed camera."""
DISTURBED, DISTURBED_NIGHTS = 0.85, 0.5
"""How many of the second views are disturbed."""
FIRST_CELL, STRIDE, COLUMNS = 17.5, 16.0, 13
"""Pixels of an input of 227 from its border to the middle of the first cell and from one cell to the next, and cells a
side; the same for pool2, conv3 and conv4."""


Kind = Literal["displaced", "cameras", "neighbours"]
"""Two views of one photograph, a day and a night of a fixed camera, or two frames of one walk or drive."""


class Displacement(NamedTuple):
    """How two views of one scene belong together.

    answers: int64 [n, 2], cells of the first view (row * COLUMNS + column) and the cells of the second that show the
        same.
    photograph: the number of the first view's photograph, in order of names.
    camera: the fixed camera that took it; empty: none did.
    """

    answers: NDArray[np.int64]
    photograph: int
    kind: Kind
    camera: str


class DisplacedViews(NamedTuple):
    """Two views of one scene, uint8 [side, side, 3], and how they belong together."""

    first: Pixels
    second: Pixels
    displacement: Displacement


def displaced_views(photographs: Path, side: int, count: int, seed: int) -> Iterator[DisplacedViews]:
    """Draw pairs from the training photographs; the same seed draws the same ones."""
    paths = split_photographs(photographs).train
    weights, numbers = source_weights(paths, photographs), {path: number for number, path in enumerate(paths)}
    cameras = [both for both in day_and_night(paths, photographs).values() if all(both)]
    generator = np.random.default_rng(seed)
    for _ in range(count):
        camera = bool(cameras) and generator.random() < CAMERA_SHARE
        if camera:
            both = cameras[int(generator.integers(len(cameras)))]
            chosen = [pictures[int(generator.integers(len(pictures)))] for pictures in both]
        else:
            chosen = [paths[int(generator.choice(len(paths), p=weights))]]
        first, second, answers = displaced([read(path) for path in chosen], side, generator)
        if generator.random() < (DISTURBED_NIGHTS if camera else DISTURBED):
            second = augment(second, generator)
        kind: Kind = "cameras" if camera else "displaced"
        yield DisplacedViews(first, second, Displacement(answers, numbers[chosen[0]], kind, fixed_camera(chosen[0])))


def fixed_camera(photograph: Path) -> str:
    """The fixed camera that took a photograph; empty: none did."""
    return photograph.parent.name if photograph.parent.parent.name == DAY_NIGHT else ""


def displaced(
    pictures: Sequence[Pixels], side: int, generator: np.random.Generator
) -> tuple[Pixels, Pixels, NDArray[np.int64]]:
    """A view of the first picture, a displaced one of the last, which shows the same scene, and what answers what."""
    height, width = pictures[0].shape[:2]
    size = generator.uniform(0.72, 0.95)
    other = float(np.clip(size * np.exp(generator.uniform(-0.16, 0.16)), 0.55, 1.0))
    middle = generator.uniform(size / 2, 1 - size / 2, 2)
    there = np.clip(middle + generator.uniform([-0.12, -0.05], [0.12, 0.05]), other / 2, 1 - other / 2)
    angle = np.deg2rad(generator.normal(0, 2.5))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    corners, extent = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2, np.array([width, height])
    bent = corners * (1 + generator.normal(0, 0.025, (4, 2)))
    windows = (corners * size + middle) * extent, (bent * other * extent) @ turn + there * extent
    target = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32)
    warps = [cv2.getPerspectiveTransform(window.astype(np.float32), target) for window in windows]
    shown = pictures[0], np.asarray(cv2.resize(pictures[-1], (width, height)), np.uint8)
    first, second = (
        np.asarray(cv2.warpPerspective(picture, warp, (side, side), borderMode=cv2.BORDER_REFLECT), np.uint8)
        for picture, warp in zip(shown, warps, strict=True)
    )
    return first, second, answering(warps[1] @ np.linalg.inv(warps[0]))


def answering(warp: NDArray[np.float64]) -> NDArray[np.int64]:
    """The cells whose middles the warp of an input, float64 [3, 3], leaves in the frame, and where; int64 [n, 2]."""
    rows, columns = np.divmod(np.arange(COLUMNS**2), COLUMNS)
    middles = FIRST_CELL + STRIDE * np.stack([columns, rows], axis=1)
    moved = cv2.perspectiveTransform(middles[np.newaxis], warp)[0]
    cells = np.rint((moved - FIRST_CELL) / STRIDE).astype(np.int64)
    seen = np.flatnonzero(((cells >= 0) & (cells < COLUMNS)).all(axis=1))
    return np.stack([seen, cells[seen, 1] * COLUMNS + cells[seen, 0]], axis=1)
