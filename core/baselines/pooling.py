"""Whole maps as one vector: summed, their maxima, crossed with the next layer, or just as they are."""

from __future__ import annotations

from core.baselines.entry import Entry
from core.baselines.maps import Array, pooled
from core.baselines.system import About
from core.method.equations import power

GAMMA = 0.5
LAYER, NEXT_LAYER = "conv3", "conv4"


def sum_pool(maps: Array) -> Array:
    """Σ of each map over its cells: [X, Y, K] to [K]."""
    return maps.sum(axis=(0, 1))


def max_pool(maps: Array) -> Array:
    """The maximum of each map: [X, Y, K] to [K]."""
    return maps.max(axis=(0, 1))


def whole(maps: Array) -> Array:
    """All activations in a row: [X, Y, K] to [X·Y·K]."""
    return maps.reshape(-1)


def cross_pool(maps: Array, following: Array) -> Array:
    """P_k = Σ_i x_i a_ik for each map k of the following layer: the local descriptors x_i of the cells,
    weighted by that map's activations a_ik (Liu et al.), and the power γ of that, as for a VLAD.

    Args:
        maps: float32 [X, Y, K].
        following: float32 [X, Y, L], of the same grid.

    Returns:
        float32 [L·K].
    """
    local = maps.reshape(-1, maps.shape[2])  # cells x K
    weights = following.reshape(-1, following.shape[2])  # cells x L
    if len(local) != len(weights):
        raise ValueError("layers that are crossed have the same number of cells")
    return power(weights.T @ local, GAMMA).reshape(-1)


SYSTEMS: tuple[Entry, ...] = (
    pooled(
        About(
            "sum-pool",
            "Sum-Pool",
            "Babenko, Lempitsky: Aggregating Deep Convolutional Features for Image Retrieval, ICCV 2015",
            {"layer": NEXT_LAYER},
        ),
        sum_pool,
        NEXT_LAYER,
    ),
    pooled(
        About(
            "max-pool",
            "Max-Pool",
            "Tolias, Sicre, Jégou: Particular Object Retrieval with Integral Max-Pooling of CNN Activations (MAC), "
            "ICLR 2016",
            {"layer": NEXT_LAYER},
        ),
        max_pool,
        NEXT_LAYER,
    ),
    pooled(
        About(
            "cross-pool",
            "Cross-Pool",
            "Liu, Shen, van den Hengel: The Treasure beneath Convolutional Layers: Cross-convolutional-layer Pooling "
            "for Image Classification, CVPR 2015",
            {"layers": (LAYER, NEXT_LAYER), "gamma": GAMMA},
        ),
        cross_pool,
        LAYER,
        NEXT_LAYER,
    ),
    pooled(
        About(
            "whole",
            "Whole",
            "Sünderhauf, Shirazi, Dayoub, Upcroft, Milford: On the Performance of ConvNet Features for Place "
            "Recognition, IROS 2015",
            {"layer": NEXT_LAYER},
        ),
        whole,
        NEXT_LAYER,
    ),
)
