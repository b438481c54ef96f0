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
"""The longest side of a drawing, in pixels."""

COLOURS = ((60, 200, 255), (255, 140, 60), (120, 220, 90), (200, 90, 230))
"""The colours of the layers, BGR, used in turn."""


@lru_cache(maxsize=16)
def layer_grids(encoder: Encoder) -> dict[str, tuple[int, int]]:
    """Rows and columns of each layer that regions come from; one forward pass finds them."""
    grids = encoder.layer_grids()
    return {layer: grids[layer] for layer in encoder.definition.layers}


def strongest(regions: Regions, limit: int | None) -> NDArray[np.int64]:
    """Indices of the ``limit`` regions of highest energy, ascending; of all regions if ``limit`` is None."""
    if limit is None or limit >= len(regions):
        return np.arange(len(regions))
    return np.sort(np.argsort(-regions.energies, kind="stable")[:limit])


def boxes(regions: Regions, grids: list[tuple[int, int]], width: float, height: float) -> NDArray[np.float64]:
    """The boxes of regions in pixels of the frame.

    The whole frame was resized, so that a layer's cells are spread evenly over it.  The receptive field of a cell is
    larger than its box.

    Args:
        grids: rows and columns of each layer.
        width, height: of the frame, pixels.

    Returns:
        float64 [T, 4], left, top, right, bottom.
    """
    cells = np.array([grids[layer] for layer in regions.layers], np.float64).reshape(-1, 2)
    scale = np.array([height, width]) / cells  # T x 2, pixels per cell
    top_left, bottom_right = regions.boxes[:, :2] * scale, regions.boxes[:, 2:] * scale
    return np.concatenate([top_left[:, ::-1], bottom_right[:, ::-1]], axis=1)


def draw(pixels: Pixels, regions: Regions, chosen: NDArray[np.int64], grids: list[tuple[int, int]]) -> bytes:
    """Draw a rectangle for each chosen region on the frame, which is shrunk if it is large.

    Args:
        pixels: uint8 [H, W, 3], BGR.
        chosen: indices of regions.
        grids: rows and columns of each layer.

    Returns:
        A PNG file.
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
