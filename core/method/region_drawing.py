"""Regions of interest in the pixels of a frame: as boxes, and drawn."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.images import encode_png
from core.frames.preprocessing import Pixels
from core.method.encoder import Encoder
from core.method.regions import Regions

LONGEST_SIDE = 1280
"""A drawing is not larger than this, in pixels."""

COLOURS = ((60, 200, 255), (255, 140, 60), (120, 220, 90), (200, 90, 230))
"""BGR, one a layer, in turn."""


@lru_cache(maxsize=16)
def layer_grids(encoder: Encoder) -> dict[str, tuple[int, int]]:
    """Rows and columns of each layer that regions come from; found by a forward pass, once."""
    grids = encoder.layer_grids()
    return {layer: grids[layer] for layer in encoder.definition.layers}


def strongest(regions: Regions, limit: int | None) -> NDArray[np.int64]:
    """Indices of the ``limit`` regions of highest energy, all if None, in the order that they stand in."""
    if limit is None or limit >= len(regions):
        return np.arange(len(regions))
    return np.sort(np.argsort(-regions.energies, kind="stable")[:limit])


def boxes(regions: Regions, grids: list[tuple[int, int]], width: float, height: float) -> NDArray[np.float64]:
    """left, top, right, bottom of each region in pixels; float64 [T, 4].

    The frame was resized whole, so a layer's cells are spread evenly over it; what a cell really
    sees is wider (its receptive field).

    Args:
        grids: rows and columns of each layer.
        width, height: of the frame, pixels.
    """
    cells = np.array([grids[layer] for layer in regions.layers], np.float64).reshape(-1, 2)
    scale = np.array([height, width]) / cells  # T x 2, pixels per cell
    top_left, bottom_right = regions.boxes[:, :2] * scale, regions.boxes[:, 2:] * scale
    return np.concatenate([top_left[:, ::-1], bottom_right[:, ::-1]], axis=1)


def draw(pixels: Pixels, regions: Regions, chosen: NDArray[np.int64], grids: list[tuple[int, int]]) -> bytes:
    """A PNG of the frame, shrunk if it is large, with a rectangle for each chosen region.

    Args:
        pixels: H x W x 3 uint8, BGR.
        chosen: indices of regions.
        grids: rows and columns of each layer.
    """
    height, width = pixels.shape[:2]
    factor = min(1.0, LONGEST_SIDE / max(height, width))
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    canvas = np.array(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    corners = np.round(boxes(regions, grids, size[0], size[1])).astype(int)
    for index in chosen[::-1]:  # the strongest of a layer last, on top
        left, top, right, bottom = (int(corner) for corner in corners[index])
        colour = COLOURS[int(regions.layers[index]) % len(COLOURS)]
        cv2.rectangle(canvas, (left, top), (right - 1, bottom - 1), colour, 1, cv2.LINE_AA)
    return encode_png(canvas)
