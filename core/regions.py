"""Regions of interest: connected cells of like activation, and what lies in their boxes.

Thesis, equations 3.1–3.4 (one layer) and 4.1–4.5 (several layers).  A region is an 8-connected
group of cells of one feature map whose activations have the same quantised level
``floor(activation / step)``; level 0 and below is background.

The pass is pruned without changing its result: division and floor are monotonic, so every cell of
a higher level exceeds every cell of a lower one, and so do the means of their regions.  Only the
cells at or above the level where ``count`` regions are complete are ever labelled.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

Activations = NDArray[np.float32]

HISTOGRAM_BINS = 4096
"""Levels of the histogram that prunes; all higher levels share its last bin."""

TABLES = 8
"""Summed-area tables that a thread keeps."""

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


def _foreground(
    activations: Activations, step: np.float32
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Cells of level 1 and above: flat cell index (y * width + x) and channel of each, and its level, all [F]."""
    values = activations.reshape(-1)
    # NumPy compares sixteen values at a time, and few pass: much quicker than a compiled loop.
    passed = np.flatnonzero(values >= step)
    cells, channels = np.divmod(passed, activations.shape[2])
    return cells, channels, np.floor(values[passed] / step)


@numba.njit(cache=True, nogil=True)
def _histogram(levels):  # type: ignore[no-untyped-def]
    """How many cells each level has, int64 [HISTOGRAM_BINS]."""
    histogram = np.zeros(HISTOGRAM_BINS, np.int64)
    for level in levels:
        histogram[int(min(level, np.float32(HISTOGRAM_BINS - 1)))] += 1
    return histogram


@numba.njit(cache=True, nogil=True)
def _level_with(histogram, wanted):  # type: ignore[no-untyped-def]
    """The highest level >= 1 at or above which at least ``wanted`` cells lie (1 if there are fewer)."""
    seen, level = 0, HISTOGRAM_BINS
    while level > 1 and seen < wanted:
        level -= 1
        seen += histogram[level]
    return level


@numba.njit(cache=True, nogil=True)
def _by_channel(maps, levels, lowest, channels):  # type: ignore[no-untyped-def]
    """The cells of level >= ``lowest``, sorted by channel and within it as before.

    Returns their indices, and where each channel starts, int64 [K + 1].
    """
    starts = np.zeros(channels + 1, np.int64)
    for i in range(len(maps)):
        if levels[i] >= lowest:
            starts[maps[i] + 1] += 1
    for k in range(channels):
        starts[k + 1] += starts[k]
    order = np.empty(starts[channels], np.int64)
    fill = starts[:-1].copy()
    for i in range(len(maps)):
        if levels[i] >= lowest:
            order[fill[maps[i]]] = i
            fill[maps[i]] += 1
    return order, starts


@numba.njit(cache=True, nogil=True)
def _label(activations, cells, maps, levels, lowest):  # type: ignore[no-untyped-def]
    """All regions of level >= ``lowest`` in order of their first cell (map-major, then row-major).

    Returns boxes int32 [R, 4], mean activations float64 [R], channels int32 [R].
    """
    height, width, channels = activations.shape
    order, starts = _by_channel(maps, levels, lowest, channels)
    boxes = np.empty((len(order), 4), np.int32)
    energies = np.empty(len(order), np.float64)
    owners = np.empty(len(order), np.int32)
    found = 0
    grid = np.zeros((height + 2, width + 2), np.float32)  # with a rim of background
    stack = np.empty(height * width, np.int64)
    for k in range(channels):
        members = order[starts[k] : starts[k + 1]]
        for i in members:
            grid[cells[i] // width + 1, cells[i] % width + 1] = levels[i]
        for i in members:
            y, x = cells[i] // width, cells[i] % width
            level = grid[y + 1, x + 1]
            if level == 0:  # taken by an earlier region
                continue
            top, left, bottom, right = y, x, y, x
            total, size = 0.0, 0
            grid[y + 1, x + 1] = 0
            stack[0], depth = cells[i], 1
            while depth > 0:
                depth -= 1
                y, x = stack[depth] // width, stack[depth] % width
                total += activations[y, x, k]
                size += 1
                top, left, bottom, right = min(top, y), min(left, x), max(bottom, y), max(right, x)
                for v in range(y, y + 3):
                    for u in range(x, x + 3):
                        if grid[v, u] == level:
                            grid[v, u] = 0
                            stack[depth] = (v - 1) * width + u - 1
                            depth += 1
            boxes[found, 0], boxes[found, 1] = top, left
            boxes[found, 2], boxes[found, 3] = bottom + 1, right + 1
            energies[found] = total / size
            owners[found] = k
            found += 1
    return boxes[:found], energies[:found], owners[:found]


@numba.njit(cache=True, nogil=True)
def _strongest(activations, cells, maps, levels, count):  # type: ignore[no-untyped-def]
    """The ``count`` regions of highest energy over all maps (eq. 3.3), ties by first occurrence."""
    histogram = _histogram(levels)
    wanted = FIRST_GUESS * count
    while True:
        lowest = _level_with(histogram, wanted)
        boxes, energies, owners = _label(activations, cells, maps, levels, lowest)
        if len(energies) >= count or lowest == 1:
            break
        wanted *= 2
    order = np.argsort(-energies, kind="mergesort")[:count]
    return boxes[order], energies[order], owners[order]


@numba.njit(cache=True, nogil=True)
def _box_sums(activations, boxes, table, sums):  # type: ignore[no-untyped-def]
    """Put the sum of the local descriptors in each box into ``sums``, float32 [T, K], by the summed-area ``table``."""
    height, width, channels = activations.shape
    row = np.empty(channels, np.float64)
    for y in range(height):
        row[:] = 0
        for x in range(width):
            for k in range(channels):
                row[k] += activations[y, x, k]
                table[y + 1, x + 1, k] = table[y, x + 1, k] + row[k]
    for t in range(len(boxes)):
        top, left, bottom, right = boxes[t]
        for k in range(channels):
            sums[t, k] = table[bottom, right, k] - table[top, right, k] - table[bottom, left, k] + table[top, left, k]


class _Workspace(threading.local):
    """The summed-area tables that one thread's passes share: fresh pages would cost as much as the sums."""

    def __init__(self) -> None:
        self._tables: dict[tuple[int, ...], NDArray[np.float64]] = {}

    def table(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """The table for activations of this shape; an encoder has few."""
        if shape not in self._tables:
            if len(self._tables) >= TABLES:
                self._tables.clear()
            height, width, channels = shape
            # The first row and column are never written: they stay zero.
            self._tables[shape] = np.zeros((height + 1, width + 1, channels), np.float64)
        return self._tables[shape]


_workspace = _Workspace()


def extract_regions(layers: Sequence[Activations], steps: Sequence[float], count: int) -> Regions:
    """The ``count`` strongest regions of each layer and their features, fused (eqs. 3.1–3.4, 4.1–4.5).

    Args:
        layers: of one frame, each float32 [X, Y, K], rectified and finite, channels last; K is the
            same for all, X and Y need not be.
        steps: quantisation step q > 0 of each layer, in units of its activations.
        count: N, per layer; fewer are returned where a layer has fewer.

    Returns:
        At most N regions a layer; none for a blank frame.

    Raises:
        ValueError: a step or ``count`` is not positive, an array is not 3-D, or K differs.
    """
    if count < 1 or not all(step > 0 for step in steps) or not all(layer.ndim == 3 for layer in layers):
        raise ValueError(f"steps {tuple(steps)} and count {count} must be positive, activations 3-D")
    if len({layer.shape[2] for layer in layers}) != 1:
        raise ValueError("the layers that are fused have the same number of channels")
    grids = [np.ascontiguousarray(layer, np.float32) for layer in layers]
    found = [
        _strongest(grid, *_foreground(grid, np.float32(step)), count) for grid, step in zip(grids, steps, strict=True)
    ]
    features = np.empty((sum(len(boxes) for boxes, _, _ in found), layers[0].shape[2]), np.float32)
    start = 0
    for grid, (boxes, _, _) in zip(grids, found, strict=True):
        _box_sums(grid, boxes, _workspace.table(grid.shape), features[start : start + len(boxes)])
        start += len(boxes)
    return Regions(
        boxes=np.concatenate([boxes for boxes, _, _ in found]),
        energies=np.concatenate([energies for _, energies, _ in found]).astype(np.float32),
        channels=np.concatenate([channels for _, _, channels in found]),
        layers=np.repeat(np.arange(len(found), dtype=np.int32), [len(boxes) for boxes, _, _ in found]),
        features=features,
    )


def box_sums(grid: Activations, boxes: NDArray[np.int32]) -> NDArray[np.float32]:
    """The sum of a layer's local descriptors, float32 [X, Y, K], in each box, int32 [T, 4]; float32 [T, K]."""
    sums = np.empty((len(boxes), grid.shape[2]), np.float32)
    _box_sums(np.ascontiguousarray(grid, np.float32), boxes, _workspace.table(grid.shape), sums)
    return sums


def unit_length(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Each row of float32 [T, K] divided by its length; a zero row stays zero."""
    lengths = np.sqrt(np.einsum("tk,tk->t", features, features))[:, None]
    return np.divide(features, lengths, out=np.zeros_like(features), where=lengths > 0)
