"""Regions of interest: connected cells of like activation, and what lies in their boxes.

Thesis, equations 3.1–3.4 (one layer) and 4.1–4.5 (several layers).  A region is an 8-connected
group of cells of one feature map whose activations have the same quantised level
``floor(activation / step)``; level 0 and below is background.

The pass is pruned without changing its result: division and floor are monotonic, so every cell of
a higher level exceeds every cell of a lower one, and so do the means of their regions.  Only the
cells at or above the level where ``count`` regions are complete are ever labelled (``components.py``).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numba
import numpy as np
from numpy.typing import NDArray

from core.components import DOUBLES, INTEGERS, SINGLES, bits_shape, strongest

Activations = NDArray[np.float32]

SHAPES = 8
"""Shapes of layers for which a thread keeps room to work in."""

FEW = 16
"""Cells of a box that are summed as they are; the rounding of so few is far under that of a feature's length."""


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

    def parts(self, layers: int) -> list[slice]:
        """Where the regions of each of so many layers stand."""
        ends = np.searchsorted(self.layers, np.arange(layers + 1)).tolist()
        return [slice(start, stop) for start, stop in pairwise(ends)]


@numba.njit(cache=True, nogil=True)
def _fill(activations, table):  # type: ignore[no-untyped-def]
    """The summed-area table: sums over all cells above and to the left; its first row and column stay zero."""
    height, width, channels = activations.shape
    row = np.empty(channels, np.float64)
    for y in range(height):
        row[:] = 0
        for x in range(width):
            for k in range(channels):
                row[k] += activations[y, x, k]
                table[y + 1, x + 1, k] = table[y, x + 1, k] + row[k]


@numba.njit(cache=True, nogil=True, inline="always")
def _add_few(cells, top, left, bottom, right, width, total):  # type: ignore[no-untyped-def]
    """The sum over a small box, two cells at a time; float32 [X·Y, K] to [K]."""
    for y in range(top, bottom):
        at, stop = y * width + left, y * width + right
        if y == top and stop - at == 1:
            one = cells[at]
            for k in range(len(total)):
                total[k] = one[k]
            at += 1
        elif y == top:
            one, two = cells[at], cells[at + 1]
            for k in range(len(total)):
                total[k] = one[k] + two[k]
            at += 2
        while at + 1 < stop:
            one, two = cells[at], cells[at + 1]
            for k in range(len(total)):
                total[k] += one[k] + two[k]
            at += 2
        if at < stop:
            one = cells[at]
            for k in range(len(total)):
                total[k] += one[k]


@numba.njit(cache=True, nogil=True)
def _box_sums(activations, boxes, table, sums):  # type: ignore[no-untyped-def]
    """Put the sum of the local descriptors in each box into ``sums``, float32 [T, K].

    Most boxes are small and summed directly.  When the others hold more cells together than a summed-area table
    has, ``table``, float64 [X + 1, Y + 1, K], is filled.
    """
    height, width, channels = activations.shape
    cells = activations.reshape(height * width, channels)
    many = 0
    for t in range(len(boxes)):
        area = (boxes[t, 2] - boxes[t, 0]) * (boxes[t, 3] - boxes[t, 1])
        many += area if area > FEW else 0
    tabled = many > 2 * height * width
    if tabled:
        _fill(activations, table)
    exact = np.empty(channels, np.float64)
    for t in range(len(boxes)):
        top, left, bottom, right = boxes[t, 0], boxes[t, 1], boxes[t, 2], boxes[t, 3]
        total = sums[t]
        if (bottom - top) * (right - left) <= FEW:
            _add_few(cells, top, left, bottom, right, width, total)
        elif tabled:
            for k in range(channels):
                total[k] = table[bottom, right, k] - table[top, right, k] - table[bottom, left, k] + table[top, left, k]
        else:
            exact[:] = 0
            for y in range(top, bottom):
                for at in range(y * width + left, y * width + right):
                    for k in range(channels):
                        exact[k] += cells[at, k]
            for k in range(channels):
                total[k] = exact[k]


@dataclass(frozen=True)
class _Room:
    """What a pass over a layer works in; fresh pages would cost as much as the pass itself."""

    cells: NDArray[np.int32]
    singles: NDArray[np.float32]
    doubles: NDArray[np.float64]
    bits: NDArray[np.uint64]
    firsts: NDArray[np.int32]
    table: NDArray[np.float64]


class _Workspace(threading.local):
    """The rooms of one thread, by the shape of the layer; an encoder has few."""

    def __init__(self) -> None:
        self._rooms: dict[tuple[int, ...], _Room] = {}

    def room(self, shape: tuple[int, ...]) -> _Room:
        """The room for activations of this shape."""
        found = self._rooms.get(shape)
        if found is None:
            if len(self._rooms) >= SHAPES:
                self._rooms.clear()
            height, width, channels = shape
            values = height * width * channels
            found = _Room(
                cells=np.empty((INTEGERS, values), np.int32),
                singles=np.empty((SINGLES, values), np.float32),
                doubles=np.empty((DOUBLES, values), np.float64),
                bits=np.zeros(bits_shape(height, width, channels), np.uint64),
                firsts=np.zeros(bits_shape(height, width, channels), np.int32),
                table=np.zeros((height + 1, width + 1, channels), np.float64),
            )
            self._rooms[shape] = found
        return found


_workspace = _Workspace()


def find_regions(layers: Sequence[Activations], steps: Sequence[float], count: int) -> Regions:
    """As :func:`extract_regions`, but without the features: float32 [T, 0]."""
    if count < 1 or not all(step > 0 for step in steps) or not all(layer.ndim == 3 for layer in layers):
        raise ValueError(f"steps {tuple(steps)} and count {count} must be positive, activations 3-D")
    room = count * len(layers)
    boxes, energies = np.empty((room, 4), np.int32), np.empty(room, np.float32)
    channels, owners = np.empty(room, np.int32), np.empty(room, np.int32)
    end = 0
    for index, (layer, step) in enumerate(zip(layers, steps, strict=True)):
        work = _workspace.room(layer.shape)
        start, stop = end, end + count
        end += strongest(
            np.ascontiguousarray(layer, np.float32),
            np.float32(step),
            work.cells,
            work.singles,
            work.doubles,
            work.bits,
            work.firsts,
            boxes[start:stop],
            energies[start:stop],
            channels[start:stop],
        )
        owners[start:end] = index
    return Regions(boxes[:end], energies[:end], channels[:end], owners[:end], np.empty((end, 0), np.float32))


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
    found = find_regions(layers, steps, count)
    if len({layer.shape[2] for layer in layers}) != 1:
        raise ValueError("the layers that are fused have the same number of channels")
    features = np.empty((len(found), layers[0].shape[2]), np.float32)
    for layer, part in zip(layers, found.parts(len(layers)), strict=True):
        box_sums(layer, found.boxes[part], features[part])
    return Regions(found.boxes, found.energies, found.channels, found.layers, features)


def box_sums(grid: Activations, boxes: NDArray[np.int32], out: Activations | None = None) -> NDArray[np.float32]:
    """The sum of a layer's local descriptors, float32 [X, Y, K], in each box, int32 [T, 4]; float32 [T, K].

    Args:
        out: where to put them, float32 [T, K]; None: a new array.
    """
    if out is None:
        out = np.empty((len(boxes), grid.shape[2]), np.float32)
    _box_sums(np.ascontiguousarray(grid, np.float32), boxes, _workspace.room(grid.shape).table, out)
    return out


def unit_length(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Each row of float32 [T, K] divided by its length; a zero row stays zero."""
    lengths = np.sqrt(np.einsum("tk,tk->t", features, features))[:, None]
    return np.divide(features, lengths, out=np.zeros_like(features), where=lengths > 0)
