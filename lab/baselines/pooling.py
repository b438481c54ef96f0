"""Pooling: the maps of one or two layers of a network, made one vector.

* Sum-Pool: Babenko, Lempitsky: Aggregating Deep Convolutional Features for Image Retrieval, ICCV 2015.
* Max-Pool (MAC) and R-MAC: Tolias, Sicre, Jégou: Particular Object Retrieval with Integral Max-Pooling of CNN
  Activations, ICLR 2016.  The regional vectors of R-MAC are power- and L2-normalized as in the thesis (section
  4.4.1), where the paper whitens them by a PCA of another image set.
* SPP: He, Zhang, Ren, Sun: Spatial Pyramid Pooling in Deep Convolutional Networks for Visual Recognition, ECCV 2014;
  on the activations of HybridNet by Chen et al.: Deep Learning Features at Scale for Visual Place Recognition, ICRA
  2017.
* Cross-Pool: Liu, Shen, van den Hengel: The Treasure beneath Convolutional Layers: Cross-convolutional-layer Pooling
  for Image Classification, CVPR 2015.
* Whole: Sünderhauf, Shirazi, Dayoub, Upcroft, Milford: On the Performance of ConvNet Features for Place Recognition,
  IROS 2015.

Maps are float32 [X, Y, K] of one frame, rectified, as ``FeatureExtractor.activations`` gives them; those of a blank
frame are zero.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from core.frames.preprocessing import Pixels
from core.method.equations import power
from lab.baselines.system import (
    About,
    Array,
    Constants,
    Description,
    InnerProducts,
    ReferenceIndex,
    Resources,
    stack,
    system_identity,
    unit,
)

if TYPE_CHECKING:
    from core.method.features import FeatureExtractor

Pool = Callable[..., Array]
"""Maps of one or more layers to float32 [D], of any length."""

EARLY, LATE = "conv3", "conv4"
GAMMA = 0.5

SUM_POOL = About(
    "sum-pool",
    "Sum-Pool",
    "Babenko, Lempitsky: Aggregating Deep Convolutional Features for Image Retrieval, ICCV 2015",
    {"layer": LATE},
)
MAX_POOL = About(
    "max-pool",
    "Max-Pool",
    "Tolias, Sicre, Jégou: Particular Object Retrieval with Integral Max-Pooling of CNN Activations (MAC), ICLR 2016",
    {"layer": LATE},
)
CROSS_POOL = About(
    "cross-pool",
    "Cross-Pool",
    "Liu, Shen, van den Hengel: The Treasure beneath Convolutional Layers: Cross-convolutional-layer Pooling "
    "for Image Classification, CVPR 2015",
    {"layers": (EARLY, LATE), "gamma": GAMMA},
)
WHOLE = About(
    "whole",
    "Whole",
    "Sünderhauf, Shirazi, Dayoub, Upcroft, Milford: On the Performance of ConvNet Features for Place "
    "Recognition, IROS 2015",
    {"layer": LATE},
)


# Each whole map


def sum_pool(maps: Array) -> Array:
    """Σ of each map over its cells: [X, Y, K] to [K]."""
    return maps.sum(axis=(0, 1))


def max_pool(maps: Array) -> Array:
    """The maximum of each map: [X, Y, K] to [K]."""
    return maps.max(axis=(0, 1))


def flatten(maps: Array) -> Array:
    """All activations in a row: [X, Y, K] to [X·Y·K]."""
    return maps.reshape(-1)


def cross_pool(maps: Array, following: Array) -> Array:
    """P_k = Σ_i x_i a_ik for each map k of the following layer, with the power γ of a VLAD.

    The local descriptors x_i of the cells are weighted by that map's activations a_ik (Liu et al.).

    Args:
        maps: float32 [X, Y, K].
        following: float32 [X, Y, L], of the same grid.

    Returns:
        float32 [L·K].
    """
    local = maps.reshape(-1, maps.shape[2])  # cells x K
    weights = following.reshape(-1, following.shape[2])  # cells x L
    if len(local) != len(weights):
        raise ValueError("layers that are crossed must have the same number of cells")
    return power(weights.T @ local, GAMMA).reshape(-1)


# Spatial pyramid


LEVELS = (1, 2, 3, 4)
SPP = About(
    "spp",
    "SPP",
    "He, Zhang, Ren, Sun: Spatial Pyramid Pooling in Deep Convolutional Networks for Visual Recognition, ECCV 2014",
    {"levels": LEVELS, "layer": LATE},
)


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


# R-MAC


L = 3
OVERLAP = 0.4
RMAC_PAPER = "Tolias, Sicre, Jégou: Particular Object Retrieval with Integral Max-Pooling of CNN Activations, ICLR 2016"
RMAC_CONSTANTS: Constants = {"L": L, "overlap": OVERLAP, "gamma": GAMMA, "layer": LATE}
RMAC = About("rmac", "RMAC", RMAC_PAPER, RMAC_CONSTANTS)


def extra_regions(height: int, width: int) -> int:
    """How many more regions the longer side has at each scale, 1 to 6; none on a square.

    The number is the one by which neighbours at scale 1 overlap most nearly by 40 %.
    """
    short, excess = min(height, width), abs(height - width)
    if excess == 0:
        return 0
    return min(range(1, 7), key=lambda more: abs((short - excess / more) / short - OVERLAP))


def square_regions(height: int, width: int) -> list[tuple[slice, slice]]:
    """The square regions of scales l = 1 … L with sides 2·min(height, width)/(l + 1), as rows and columns."""
    more = extra_regions(height, width)
    found = []
    for scale in range(1, L + 1):
        side = max(1, 2 * min(height, width) // (scale + 1))
        tops = starts(height, side, scale + (more if height > width else 0))
        lefts = starts(width, side, scale + (more if width > height else 0))
        found += [(slice(top, top + side), slice(left, left + side)) for top in tops for left in lefts]
    return found


def starts(length: int, side: int, count: int) -> list[int]:
    """Where ``count`` windows of ``side`` cells begin, evenly from the first cell to the last possible one."""
    step = (length - side) / (count - 1) if count > 1 else 0.0
    return [math.floor(index * step) for index in range(count)]


def regional_vectors(maps: Array) -> Array:
    """Maxima in each region, power- and L2-normalized: float32 [X, Y, K] to [T, K]."""
    maxima = np.stack([maps[rows, columns].max(axis=(0, 1)) for rows, columns in square_regions(*maps.shape[:2])])
    return unit(power(maxima, GAMMA))


def rmac(maps: Array) -> Array:
    """Σ of the regional vectors: float32 [X, Y, K] to [K]."""
    return regional_vectors(maps).sum(axis=0)


# The systems


def read_maps(extractor: FeatureExtractor, pixels: Pixels) -> tuple[list[Array], float]:
    """The maps of each layer of one frame, and the milliseconds of the forward pass."""
    began = time.perf_counter()
    maps = extractor.activations([pixels])[0]
    return maps, 1e3 * (time.perf_counter() - began)


class MapsSystem(ABC):
    """The base of systems whose description of a frame is made of its maps alone.

    Args:
        extractor: gives the maps of the layers that :meth:`keep` gets.
    """

    sequential = False

    def __init__(self, about: About, extractor: FeatureExtractor) -> None:
        self.about, self.extractor = about, extractor
        self.identity = system_identity(about, features=extractor.origin)

    @abstractmethod
    def keep(self, maps: list[Array]) -> dict[str, Array]:
        """The arrays that describe a frame, by name, from the maps of each layer."""

    @abstractmethod
    def index(self, references: Sequence[Description]) -> ReferenceIndex: ...

    def describe(self, pixels: Pixels) -> Description:
        maps, forward = read_maps(self.extractor, pixels)
        began = time.perf_counter()
        arrays = self.keep(maps)
        return Description(arrays, {"forward": forward, "pool": 1e3 * (time.perf_counter() - began)})


class PooledSystem(MapsSystem):
    """Maps pooled to one vector of unit length; scores are cosines."""

    def __init__(self, about: About, extractor: FeatureExtractor, pool: Pool) -> None:
        super().__init__(about, extractor)
        self.pool = pool

    def keep(self, maps: list[Array]) -> dict[str, Array]:
        return {"descriptor": unit(self.pool(*maps))}

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return InnerProducts(stack(references))


def pooled(pool: Pool, *layers: str) -> Callable[[About, Resources], PooledSystem]:
    """How a system is built that pools ``layers`` of the packaged network."""
    return lambda about, resources: PooledSystem(about, resources.extractor(*layers), pool)
