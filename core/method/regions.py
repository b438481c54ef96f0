"""Regions of interest and their features (thesis, equations 3.1–3.5 for one layer and 4.1–4.5 for several).

A region is an 8-connected group of cells of one feature map whose activations have the same quantised level
``floor(activation / step)``; level 0 and below is background.  ``equations.py`` states this in plain NumPy; here the
compiled loops of ``core.kernels.regions`` compute it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from core.kernels.regions import projected_within, strongest, sums_within

Activations = NDArray[np.float32]


@dataclass(frozen=True)
class Regions:
    """T regions of one frame, layer by layer, and within a layer by falling energy.

    boxes: int32 [T, 4], top, left, bottom, right in cells of the layer's grid, half-open.
    energies: float32 [T], mean activation inside the region (equation 3.2).
    channels: int32 [T], the feature map of each region.
    layers: int32 [T], the index of its layer among those fused.
    features: float32 [T, K], regional features (equation 3.4).
    """

    boxes: NDArray[np.int32]
    energies: NDArray[np.float32]
    channels: NDArray[np.int32]
    layers: NDArray[np.int32]
    features: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.energies)

    def without_features(self) -> Regions:
        """The same regions with features float32 [T, 0], a tenth of the memory."""
        return replace(self, features=self.features[:, :0].copy())

    def parts(self, layers: int) -> list[slice]:
        """The range of each layer's regions, for this many layers."""
        ends = np.searchsorted(self.layers, np.arange(layers + 1)).tolist()
        return [slice(start, stop) for start, stop in pairwise(ends)]


def find_regions(layers: Sequence[Activations], steps: Sequence[float], count: int) -> Regions:
    """Find the regions as :func:`extract_regions` does, but without their features: those are float32 [T, 0]."""
    if count < 1 or not all(step > 0 for step in steps) or not all(layer.ndim == 3 for layer in layers):
        raise ValueError(f"steps {tuple(steps)} and count {count} must be positive, activations 3-D")
    found = [
        strongest(np.ascontiguousarray(layer, np.float32), np.float32(step), count)
        for layer, step in zip(layers, steps, strict=True)
    ]
    boxes, energies, channels = (np.concatenate(parts) for parts in zip(*found, strict=True))
    owners = np.repeat(np.arange(len(layers), dtype=np.int32), [len(part) for part, _, _ in found])
    return Regions(boxes, energies, channels, owners, np.empty((len(boxes), 0), np.float32))


def extract_regions(layers: Sequence[Activations], steps: Sequence[float], count: int) -> Regions:
    """Find the ``count`` strongest regions of each layer and their features, fused (equations 3.1–3.5 and 4.1–4.5).

    Args:
        layers: of one frame, each float32 [X, Y, K], rectified and finite, channels last; K is the same for all, X and
            Y need not be.
        steps: quantisation step q > 0 of each layer, in units of its activations.
        count: N, per layer.

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
        features[part] = box_sums(layer, found.boxes[part])
    return Regions(found.boxes, found.energies, found.channels, found.layers, features)


def box_sums(grid: Activations, boxes: NDArray[np.int32]) -> NDArray[np.float32]:
    """The regional features (equation 3.4): the sum of a layer's local descriptors in each box.

    Args:
        grid: the layer's activations, float32 [X, Y, K].
        boxes: int32 [T, 4], top, left, bottom, right, half-open.

    Returns:
        float32 [T, K].
    """
    sums = np.empty((len(boxes), grid.shape[2]), np.float32)
    sums_within(np.ascontiguousarray(grid, np.float32), boxes, sums)
    return sums


def projected_box_sums(
    layer: Activations, products: Activations, boxes: NDArray[np.int32], shift: NDArray[np.float32], out: Activations
) -> None:
    """Project the sums of :func:`box_sums` to unit length (``projection.py``), into ``out``.

    The product of a sum is the sum of the cells' products, so that of the sum itself only its length is needed.

    Args:
        layer: float32 [X, Y, K].
        products: of its cells with the projection's matrix, float32 [X, Y, d].
        boxes: int32 [T, 4].
        shift: the projection's mean times its matrix, float32 [d].
        out: float32 [T, values], values <= d.
    """
    projected_within(np.ascontiguousarray(layer, np.float32), products, boxes, shift, out)
