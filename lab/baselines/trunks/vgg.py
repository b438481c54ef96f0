"""VGG-16 up to conv5_3 (Simonyan and Zisserman, 2015), the backbone of several of the compared systems.

It has thirteen 3 x 3 convolutions in five blocks, with a 2 x 2 pooling between blocks.  The weights determine the
numbers of channels, 64 · 128 · 256 · 512 · 512 in the published networks.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition, Pixels, prepare
from core.networks.network import Convolution, Layer, NetworkDefinition, Pooling, Relu
from core.networks.torch_network import TorchNetwork

BLOCKS = (2, 2, 3, 3, 3)
CONVOLUTIONS = tuple(f"conv{block}_{place}" for block, count in enumerate(BLOCKS, 1) for place in range(1, count + 1))
LAST = CONVOLUTIONS[-1]

IMAGENET_BGR = (103.939, 116.779, 123.68)
"""The mean that the network was trained with."""


def torchvision_indices() -> dict[str, int]:
    """The index of each convolution in torchvision's ``vgg16().features``, which counts rectifiers and poolings."""
    indices: dict[str, int] = {}
    place = 0
    for block, count in enumerate(BLOCKS, 1):
        for convolution in range(1, count + 1):
            indices[f"conv{block}_{convolution}"] = place
            place += 2  # itself and its rectifier
        place += 1  # the pooling
    return indices


def load_vgg16(
    weights: Mapping[str, Tensor],
    shown: InputDefinition,
    *,
    outputs: tuple[str, ...] = (LAST,),
    rectified: bool,
    ceil: bool = False,
) -> TorchNetwork:
    """Build the network up to conv5_3.

    Args:
        weights: ``conv1_1.weight`` [K, C, 3, 3], ``conv1_1.bias`` [K] and so on.
        outputs: the convolutions to return; all but conv5_3 are always rectified.
        rectified: whether conv5_3 is rectified; NetVLAD reads it before its rectifier.
        ceil: Caffe's rounding of pooled sizes, which makes no difference for sizes that are multiples of 16.

    Raises:
        InvalidModel: a tensor is missing, of another shape, or not finite.
    """
    layers: list[Layer] = []
    for name in CONVOLUTIONS:
        weight = weights.get(f"{name}.weight")
        if weight is None or weight.ndim != 4 or not weight.shape[0]:
            raise InvalidModel(f"The file has no weights of VGG-16's {name}.")
        if name.endswith("_1") and layers:
            layers.append(Pooling(name=f"pool{name[4]}", kernel=2, stride=2, ceil=ceil))
        layers.append(Convolution(name=name, channels=weight.shape[0], kernel=3, pad=1))
        if rectified or name != LAST:
            layers.append(Relu(name=name.replace("conv", "relu")))
    network = TorchNetwork(NetworkDefinition(name="vgg16", input=shown, layers=tuple(layers)), outputs)
    network.load_weights(weights)
    return network.eval().requires_grad_(False).to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def forward(network: TorchNetwork, pixels: Pixels) -> tuple[Tensor, ...]:
    """The maps of the network's outputs for one frame, float32 [K, X, Y] each."""
    image = torch.from_numpy(np.ascontiguousarray(prepare(pixels, network.input))).permute(2, 0, 1)[None]
    return tuple(maps[0] for maps in network(image))
