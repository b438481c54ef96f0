"""Spatial pyramid pooling: the maxima of each map in the cells of ever finer grids.

He, Zhang, Ren, Sun: Spatial Pyramid Pooling in Deep Convolutional Networks for Visual Recognition, ECCV
2014; on the activations of HybridNet by Chen et al.: Deep Learning Features at Scale for Visual Place
Recognition, ICRA 2017.
"""

from __future__ import annotations

import numpy as np

from core.baselines.entry import Entry
from core.baselines.maps import Array, pooled
from core.baselines.system import About

LEVELS = (1, 2, 3, 4)
LAYER = "conv4"


def bins(length: int, count: int) -> list[slice]:
    """``count`` windows over ``length`` cells: window i from floor(i·a/n) to ceil((i + 1)·a/n) (He et al.)."""
    return [slice(i * length // count, -(-(i + 1) * length // count)) for i in range(count)]


def spatial_pyramid_pool(maps: Array) -> Array:
    """Maxima in 1, 4, 9 and 16 windows: float32 [X, Y, K] to [30·K], level by level, row by row."""
    height, width, _ = maps.shape
    return np.concatenate(
        [
            maps[rows, columns].max(axis=(0, 1))
            for level in LEVELS
            for rows in bins(height, level)
            for columns in bins(width, level)
        ]
    )


SYSTEMS: tuple[Entry, ...] = (
    pooled(
        About(
            "spp",
            "SPP",
            "He, Zhang, Ren, Sun: Spatial Pyramid Pooling in Deep Convolutional Networks for Visual Recognition, "
            "ECCV 2014",
            {"levels": LEVELS, "layer": LAYER},
        ),
        spatial_pyramid_pool,
        LAYER,
    ),
)
