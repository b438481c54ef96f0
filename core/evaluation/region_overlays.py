"""Where an encoder looks: the regions of interest of a picture, to be drawn on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from core.evaluation.protocol.comparison import Box
from core.frames.preprocessing import Pixels

if TYPE_CHECKING:
    from core.method.encoder import Encoder


def region_finder(encoder: Encoder, load: Callable[[Path], Pixels]) -> Callable[[Path], list[Box]]:
    """A function from a picture to the boxes of its regions, highest energy first; none for a blank frame.

    A frame is resized whole, so a layer's cells are spread evenly over it; what a cell really sees is wider.
    """
    by_layer = encoder.layer_grids()
    grids = np.array([by_layer[layer] for layer in encoder.definition.layers], np.float64)  # rows, columns of each

    def find(path: Path) -> list[Box]:
        regions = encoder.encode(load(path)).regions
        cells = grids[regions.layers]  # T x 2
        top_left, bottom_right = regions.boxes[:, :2] / cells, regions.boxes[:, 2:] / cells
        boxes = np.concatenate([top_left[:, ::-1], bottom_right[:, ::-1]], axis=1)  # left, top, right, bottom
        return [_box(boxes[index]) for index in np.argsort(-regions.energies, kind="stable")]

    return find


def _box(corners: Sequence[float]) -> Box:
    left, top, right, bottom = (float(corner) for corner in corners)
    return left, top, right, bottom
