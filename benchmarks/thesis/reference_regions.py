"""The region pass as one writes it from the thesis with scikit-image: the reference for ours.

FROZEN.  This file is never changed again: the speed of the region pass is quoted as a multiple of
this code, per map one ``skimage.measure.label`` and one ``regionprops`` loop.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import skimage.measure
from numpy.typing import NDArray

measure: Any = skimage.measure


def reference_regions(
    activations: NDArray[np.float32], step: float, count: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float32]]:
    """The ``count`` regions of highest mean activation of one layer, and their features.

    Args:
        activations: float32 [K, X, Y], rectified.
        step: quantisation step.
        count: N.

    Returns:
        boxes [T, 4] (top, left, bottom, right, half-open), energies [T], features [T, K].
    """
    found: list[tuple[float, tuple[int, ...]]] = []
    for channel in activations:
        levels = np.floor(channel / step).astype(np.int64)
        labels = measure.label(levels, background=0, connectivity=2)
        found += [(float(region.intensity_mean), region.bbox) for region in measure.regionprops(labels, channel)]
    found.sort(key=lambda region: -region[0])
    strongest = found[:count]
    features = [activations[:, top:bottom, left:right].sum(axis=(1, 2)) for _, (top, left, bottom, right) in strongest]
    boxes = np.array([box for _, box in strongest], np.int64).reshape(-1, 4)
    return boxes, np.array([energy for energy, _ in strongest]), np.array(features, np.float32)
