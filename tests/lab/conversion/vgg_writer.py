"""A VGG-16 whose output can be told by hand: each convolution hands its maps on as they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lab.baselines.trunks.vgg import CONVOLUTIONS, LAST

Array = NDArray[np.float32]


def plain_vgg(last: float = 1.0) -> dict[str, Array]:
    """Thirteen convolutions of three channels; the last one multiplies by ``last``."""
    weights: dict[str, Array] = {}
    for name in CONVOLUTIONS:
        weight = np.zeros((3, 3, 3, 3), np.float32)
        weight[range(3), range(3), 1, 1] = last if name == LAST else 1
        weights[f"{name}.weight"], weights[f"{name}.bias"] = weight, np.zeros(3, np.float32)
    return weights


def blocks(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    """A picture of 32 x 32 blocks of one colour, all brighter than the means that are subtracted."""
    colours = np.random.default_rng(seed).integers(130, 256, (height // 32, width // 32, 3), np.uint8)
    return np.asarray(np.kron(colours, np.ones((32, 32, 1), np.uint8)), np.uint8)


def plain_maps(picture: NDArray[np.uint8], mean: tuple[float, float, float], last: float = 1.0) -> Array:
    """What conv5_3 of ``plain_vgg`` gives of ``blocks``: 3 x H/16 x W/16, less the mean.

    Args:
        picture: in the network's order of channels.
    """
    small = picture[::16, ::16].astype(np.float32) - np.array(mean, np.float32)
    return np.asarray(np.float32(last) * np.maximum(small, 0).transpose(2, 0, 1), np.float32)
