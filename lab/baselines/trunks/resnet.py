"""ResNet-50 up to its third group of blocks, conv4_x (He, Zhang, Ren, Sun: CVPR 2016), the backbone of DELF.

The layout is that of torchvision's network as a ``Sequential``: 0 is the first convolution, 1 its normalization, and
4, 5 and 6 are the groups.  The weights determine the numbers of channels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from core.errors import InvalidModel
from lab.conversion.checkpoints import as_float

GROUPS = ((4, 3, 1), (5, 4, 2), (6, 6, 2))
"""The number in the file, the count of blocks and the stride of each group."""

EPSILON = 1e-5


@dataclass(frozen=True)
class NormalizedConvolution:
    """A convolution that includes the normalization after it: weight [K, C, k, k] and bias [K]."""

    weight: Tensor
    bias: Tensor

    def __call__(self, maps: Tensor, stride: int = 1) -> Tensor:
        return conv2d(maps, self.weight, self.bias, stride, self.weight.shape[-1] // 2)


@dataclass(frozen=True)
class BottleneckBlock:
    """A bottleneck: convolutions of 1 x 1, 3 x 3 and 1 x 1; the input is added, through ``shortcut`` if needed."""

    narrow: NormalizedConvolution
    see: NormalizedConvolution
    widen: NormalizedConvolution
    shortcut: NormalizedConvolution | None
    stride: int

    def __call__(self, maps: Tensor) -> Tensor:
        found = self.widen(self.see(self.narrow(maps).relu(), self.stride).relu())
        return (found + (maps if self.shortcut is None else self.shortcut(maps, self.stride))).relu()


class ResNet50:
    """Computes the rectified maps of conv4_x: float32 [B, 3, H, W] to [B, K, H/16, W/16].

    Args:
        weights: by the names of the layout, ``0.weight``, ``1.running_mean``, ``4.0.conv1.weight`` and so on.

    Raises:
        InvalidModel: a tensor is missing, does not fit the one before it, or is not finite.
    """

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        self.tensors: dict[str, Tensor] = {}
        self._weights = weights
        self.first = self._convolution("0", "1", 7, 3)
        channels = len(self.first.bias)
        self.blocks: list[BottleneckBlock] = []
        for place, count, stride in GROUPS:
            for index in range(count):
                block = self._block(f"{place}.{index}", channels, 1 if index else stride, shortcut=not index)
                channels = len(block.widen.bias)
                self.blocks.append(block)
        self.channels = channels

    def __call__(self, images: Tensor) -> Tensor:
        maps = max_pool2d(self.first(images, 2).relu(), 3, 2, 1)
        for block in self.blocks:
            maps = block(maps)
        return maps

    def _block(self, name: str, channels: int, stride: int, shortcut: bool) -> BottleneckBlock:
        narrow = self._convolution(f"{name}.conv1", f"{name}.bn1", 1, channels)
        see = self._convolution(f"{name}.conv2", f"{name}.bn2", 3, len(narrow.bias))
        widen = self._convolution(f"{name}.conv3", f"{name}.bn3", 1, len(see.bias))
        around = self._convolution(f"{name}.downsample.0", f"{name}.downsample.1", 1, channels) if shortcut else None
        if len(widen.bias) != (channels if around is None else len(around.bias)):
            raise InvalidModel(f"{name} cannot be added to what comes into it: their channels differ.")
        return BottleneckBlock(narrow, see, widen, around, stride)

    def _convolution(self, convolution: str, normalization: str, kernel: int, channels: int) -> NormalizedConvolution:
        """(w·x - μ)·γ/√(σ² + ε) + β as one convolution."""
        weight = self._read(f"{convolution}.weight", None, channels, kernel, kernel)
        count = len(weight)
        gamma, beta, mean, variance = (
            self._read(f"{normalization}.{part}", count) for part in ("weight", "bias", "running_mean", "running_var")
        )
        if (variance < 0).any():
            raise InvalidModel(f"{normalization}.running_var has negative values.")
        factor = gamma / torch.sqrt(variance + EPSILON)
        return NormalizedConvolution(weight * factor[:, None, None, None], beta - mean * factor)

    def _read(self, name: str, *shape: int | None) -> Tensor:
        if name not in self._weights:
            raise InvalidModel(f"The file has no {name} of ResNet-50.")
        self.tensors[name] = as_float(self._weights[name], name, *shape)
        return self.tensors[name]
