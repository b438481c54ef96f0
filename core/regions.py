"""Regions of interest: connected cells of like activation, and what lies in their boxes.

Thesis, equations 3.1–3.4 (one layer) and 4.1–4.5 (several layers).  A region is an 8-connected
group of cells of one feature map whose activations have the same quantised level
``floor(activation / step)``; level 0 and below is background.

The pass is pruned without changing its result: division and floor are monotonic, so every cell of
a higher level exceeds every cell of a lower one, and so do the means of their regions.  Only the
cells at or above the level where ``count`` regions are complete are ever labelled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

Activations = NDArray[np.float32]

HISTOGRAM_BINS = 4096
"""Levels of the histogram that prunes; all higher levels share its last bin."""

FIRST_GUESS = 2
"""Cells per wanted region in the first attempt to label few enough cells."""


@dataclass(frozen=True)
class Regions:
    """T regions of one frame: layer by layer, by falling energy within a layer.

    boxes: int32 [T, 4], top, left, bottom, right in cells of the layer's grid, half-open.
    energies: float32 [T], mean activation inside the region (eq. 3.2).
    channels: int32 [T], the feature map of each region.
    layers: int32 [T], index of the layer among those fused.
    features: float32 [T, K], regional features (eq. 3.4).
    """

    boxes: NDArray[np.int32]
    energies: NDArray[np.float32]
    channels: NDArray[np.int32]
    layers: NDArray[np.int32]
    features: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.energies)


@numba.njit(cache=True, nogil=True)
def _level_with(activations, step, wanted):  # type: ignore[no-untyped-def]
    """The highest level >= 1 at or above which at least ``wanted`` cells lie (1 if there are fewer)."""
    histogram = np.zeros(HISTOGRAM_BINS, np.int64)
    for value in activations.flat:
        level = np.floor(value / step)
        if level >= 1:
            histogram[int(min(level, np.float32(HISTOGRAM_BINS - 1)))] += 1
    seen, level = 0, HISTOGRAM_BINS
    while level > 1 and seen < wanted:
        level -= 1
        seen += histogram[level]
    return level


@numba.njit(cache=True, nogil=True)
def _cells_by_channel(activations, step, lowest):  # type: ignore[no-untyped-def]
    """Cells at or above level ``lowest``, sorted by channel, then row, then column.

    Returns the flat cell index (y * width + x) of each, and where each channel starts, int64 [K + 1].
    """
    height, width, channels = activations.shape
    starts = np.zeros(channels + 1, np.int64)
    for y in range(height):
        for x in range(width):
            for k in range(channels):
                starts[k + 1] += np.floor(activations[y, x, k] / step) >= lowest
    for k in range(channels):
        starts[k + 1] += starts[k]
    cells = np.empty(starts[channels], np.int64)
    fill = starts[:-1].copy()
    for y in range(height):
        for x in range(width):
            for k in range(channels):
                if np.floor(activations[y, x, k] / step) >= lowest:
                    cells[fill[k]] = y * width + x
                    fill[k] += 1
    return cells, starts


@numba.njit(cache=True, nogil=True)
def _label(activations, step, lowest):  # type: ignore[no-untyped-def]
    """All regions of level >= ``lowest`` in order of their first cell (map-major, then row-major).

    Returns boxes int32 [R, 4], mean activations float64 [R], channels int32 [R].
    """
    height, width, channels = activations.shape
    cells, starts = _cells_by_channel(activations, step, lowest)
    boxes = np.empty((len(cells), 4), np.int32)
    energies = np.empty(len(cells), np.float64)
    maps = np.empty(len(cells), np.int32)
    found = 0
    levels = np.zeros((height + 2, width + 2), np.float32)  # with a rim of background
    stack = np.empty(height * width, np.int64)
    for k in range(channels):
        for cell in cells[starts[k] : starts[k + 1]]:
            y, x = cell // width, cell % width
            levels[y + 1, x + 1] = np.floor(activations[y, x, k] / step)
        for seed in cells[starts[k] : starts[k + 1]]:
            y, x = seed // width, seed % width
            level = levels[y + 1, x + 1]
            if level == 0:  # taken by an earlier region
                continue
            top, left, bottom, right = y, x, y, x
            total, size = 0.0, 0
            levels[y + 1, x + 1] = 0
            stack[0], depth = seed, 1
            while depth > 0:
                depth -= 1
                y, x = stack[depth] // width, stack[depth] % width
                total += activations[y, x, k]
                size += 1
                top, left, bottom, right = min(top, y), min(left, x), max(bottom, y), max(right, x)
                for v in range(y, y + 3):
                    for u in range(x, x + 3):
                        if levels[v, u] == level:
                            levels[v, u] = 0
                            stack[depth] = (v - 1) * width + u - 1
                            depth += 1
            boxes[found, 0], boxes[found, 1] = top, left
            boxes[found, 2], boxes[found, 3] = bottom + 1, right + 1
            energies[found] = total / size
            maps[found] = k
            found += 1
    return boxes[:found], energies[:found], maps[:found]


@numba.njit(cache=True, nogil=True)
def _strongest(activations, step, count):  # type: ignore[no-untyped-def]
    """The ``count`` regions of highest energy over all maps (eq. 3.3), ties by first occurrence."""
    wanted = FIRST_GUESS * count
    while True:
        lowest = _level_with(activations, step, wanted)
        boxes, energies, maps = _label(activations, step, lowest)
        if len(energies) >= count or lowest == 1:
            break
        wanted *= 2
    order = np.argsort(-energies, kind="mergesort")[:count]
    return boxes[order], energies[order], maps[order]


@numba.njit(cache=True, nogil=True)
def _box_sums(activations, boxes):  # type: ignore[no-untyped-def]
    """Sum of the local descriptors in each box by a summed-area table; float32 [T, K]."""
    height, width, channels = activations.shape
    table = np.zeros((height + 1, width + 1, channels), np.float64)
    row = np.empty(channels, np.float64)
    for y in range(height):
        row[:] = 0
        for x in range(width):
            for k in range(channels):
                row[k] += activations[y, x, k]
                table[y + 1, x + 1, k] = table[y, x + 1, k] + row[k]
    sums = np.empty((len(boxes), channels), np.float32)
    for t in range(len(boxes)):
        top, left, bottom, right = boxes[t]
        for k in range(channels):
            sums[t, k] = table[bottom, right, k] - table[top, right, k] - table[bottom, left, k] + table[top, left, k]
    return sums


def extract_regions(activations: Activations, step: float, count: int, layer: int = 0) -> Regions:
    """The ``count`` strongest regions of one layer and their features (eqs. 3.1–3.4).

    Args:
        activations: float32 [X, Y, K], rectified and finite, channels last.
        step: quantisation step q > 0, in units of the activations.
        count: N; fewer are returned where the frame has fewer.
        layer: index to mark the regions with.

    Returns:
        At most ``count`` regions; none for a blank frame.

    Raises:
        ValueError: ``step`` or ``count`` is not positive, or the array is not 3-D.
    """
    if not step > 0 or count < 1 or activations.ndim != 3:
        raise ValueError(f"step {step}, count {count} and shape {activations.shape} must be positive and 3-D")
    grid = np.ascontiguousarray(activations, np.float32)
    boxes, energies, channels = _strongest(grid, np.float32(step), count)
    return Regions(
        boxes=boxes,
        energies=energies.astype(np.float32),
        channels=channels,
        layers=np.full(len(boxes), layer, np.int32),
        features=_box_sums(grid, boxes),
    )


def fuse(regions: Sequence[Regions]) -> Regions:
    """The regions of several layers of equal K as one set, T x K (eqs. 4.4, 4.5)."""
    return Regions(
        *(
            np.concatenate([getattr(part, field) for part in regions])
            for field in ("boxes", "energies", "channels", "layers", "features")
        )
    )


def unit_length(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Each row of float32 [T, K] divided by its length; a zero row stays zero."""
    lengths = np.sqrt(np.einsum("tk,tk->t", features, features))[:, None]
    return np.divide(features, lengths, out=np.zeros_like(features), where=lengths > 0)
