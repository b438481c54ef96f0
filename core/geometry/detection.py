"""Finding the keypoints of a frame by XFeat.

A pixel is a keypoint where the network's heat has a local maximum.  The best are those with the highest product of
heat and reliability (Potje et al., 2024, section 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.masks import Mask
from core.frames.preprocessing import Pixels
from core.geometry.keypoints import MOST, RESOLUTION, SHARES, Keypoints
from core.kernels.sampling import interpolated
from core.networks.xfeat import CELL, MULTIPLE, XFeat

AREA = 320 * 240
"""Pixels of the network's input, about; a smaller frame is enlarged, so that it gives keypoints, too.  By its area
rather than by a side a wide frame gives as much as another."""
LONGEST_SIDE = 960
"""Pixels of a side of the network's input at most."""
LEAST_HEAT = 0.05
"""The heat from which on a pixel is a keypoint: the authors' choice."""
NEIGHBORHOOD = 5
"""Pixels a side of the square in which a keypoint has the highest heat: the authors' choice."""


@dataclass(frozen=True)
class ScaledFrame:
    """A frame as the network sees it.

    pixels: uint8 [rows, columns, 3], BGR; the size is that of :func:`shown_size`.
    width, height: of the frame, in pixels.
    mask: hides a part of the frame, in which there are no keypoints then.
    """

    pixels: Pixels
    width: int
    height: int
    mask: Mask | None = None

    @classmethod
    def of(cls, pixels: Pixels, mask: Mask | None = None) -> ScaledFrame:
        """A frame of any size, uint8 [H, W, 3], BGR, scaled."""
        height, width = pixels.shape[:2]
        columns, rows = shown_size(width, height)
        interpolation = cv2.INTER_AREA if columns < width else cv2.INTER_LINEAR
        shown = cv2.resize(pixels, (columns, rows), interpolation=interpolation)
        return cls(np.asarray(shown, np.uint8), width, height, mask)


def shown_scale(width: int, height: int) -> float:
    """By how much a frame is enlarged before its sides are rounded."""
    return min(sqrt(AREA / (width * height)), LONGEST_SIDE / max(width, height))


def shown_size(width: int, height: int) -> tuple[int, int]:
    """Width and height at which the network sees a frame: about AREA, both multiples of MULTIPLE."""
    scale = shown_scale(width, height)
    columns, rows = (max(1, round(side * scale / MULTIPLE)) * MULTIPLE for side in (width, height))
    return columns, rows


def find_keypoints(network: XFeat, pixels: Pixels, mask: Mask | None = None) -> Keypoints:
    """The keypoints of a frame; a blank frame has none.

    Args:
        pixels: uint8 [H, W, 3], BGR, of any size.
        mask: hides a part of the frame, in which there are no keypoints then.
    """
    return keypoints_in(network, ScaledFrame.of(pixels, mask))


def keypoints_in(network: XFeat, scaled: ScaledFrame) -> Keypoints:
    """The keypoints of a scaled frame; a blank frame has none."""
    rows, columns = scaled.pixels.shape[:2]
    maps = network(scaled.pixels)
    highest = cv2.dilate(maps.heat, np.ones((NEIGHBORHOOD, NEIGHBORHOOD), np.uint8))
    found = (maps.heat == highest) & (maps.heat > LEAST_HEAT)
    if scaled.mask is not None:
        found &= ~scaled.mask.covered(rows, columns)
    y, x = np.divmod(np.flatnonzero(found), columns)
    reliability = cv2.resize(maps.reliability, (columns, rows), interpolation=cv2.INTER_LINEAR)
    best = np.argsort(-maps.heat[y, x] * reliability[y, x], kind="stable")[:MOST]
    x, y = x[best], y[best]
    centres = np.stack([(x + 0.5) / columns, (y + 0.5) / rows], axis=1)
    positions = np.minimum(centres * SHARES, SHARES - 1).astype(np.uint16)
    return Keypoints(scaled.width, scaled.height, positions, _descriptors_at(maps.descriptors, x, y))


def _descriptors_at(maps: NDArray[np.float32], x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int8]:
    """Descriptors at pixels, interpolated between cells by cubic convolution and quantized; int8 [n, 64].

    As in the authors' code the first pixel and the last one lie on the borders of the map.
    """
    rows, columns = maps.shape[:2]
    across = x.astype(np.float32) * np.float32(columns / (columns * CELL - 1)) - np.float32(0.5)
    down = y.astype(np.float32) * np.float32(rows / (rows * CELL - 1)) - np.float32(0.5)
    found = interpolated(maps, down, across)
    lengths = np.maximum(np.linalg.norm(found, axis=1, keepdims=True), np.float32(1e-12))
    return np.clip(np.rint(found * (RESOLUTION / lengths)), -127, 127).astype(np.int8)
