"""The trunks of published networks: ResNet, VGG-16 and DINOv2, with the names of their published weights.

All sizes come from the weights themselves.  He, Zhang, Ren, Sun: Deep Residual Learning, CVPR 2016; Simonyan,
Zisserman, 2015; Oquab et al.: DINOv2, 2024; Lu et al.: CricaVPR, CVPR 2024 (the adapters).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, scaled_dot_product_attention, silu

from core.errors import InvalidModel
from lab.baselines.trunks.vgg import BLOCKS

Weights = Mapping[str, Tensor]

MOST_BLOCKS = 200
PATCH = 14
HEAD = 64
"""Values of each head of DINOv2, in all of its sizes."""

OFFSET = 0.1
"""Added to the number of patches when DINOv2's positions are scaled; its weights were trained so."""

ADAPTED = 0.2
"""Weight of CricaVPR's adapters."""


def shape_of(weights: Weights, name: str, sides: int) -> tuple[int, ...]:
    """The shape of a tensor of so many sides.

    Raises:
        InvalidModel: it is missing, or has another number of sides.
    """
    if name not in weights or weights[name].ndim != sides or not weights[name].numel():
        raise InvalidModel(f"The file has no {name} of {sides} sides, which the network's layout needs.")
    return tuple(weights[name].shape)


def count_of(weights: Weights, before: str, after: str) -> int:
    """How many there are of numbered parts, ``before`` + number + ``after``.

    Raises:
        InvalidModel: there is none, or more than any network has.
    """
    count = 0
    while f"{before}{count}{after}" in weights:
        count += 1
    if not 0 < count <= MOST_BLOCKS:
        raise InvalidModel(f"The file has {count} parts {before}N{after}, which the network's layout needs.")
    return count


# ResNet


class ResidualBlock(nn.Module):
    """Two convolutions of 3 x 3, or one between two of 1 x 1; what comes in is added."""

    def __init__(self, weights: Weights, name: str, stride: int) -> None:
        super().__init__()
        narrow = f"{name}.conv3.weight" in weights
        kernels = (1, 3, 1) if narrow else (3, 3)
        strides = (1, stride, 1) if narrow else (stride, 1)
        self.count = len(kernels)
        for number, (kernel, step) in enumerate(zip(kernels, strides, strict=True), 1):
            channels, before = shape_of(weights, f"{name}.conv{number}.weight", 4)[:2]
            self.add_module(f"conv{number}", nn.Conv2d(before, channels, kernel, step, kernel // 2, bias=False))
            self.add_module(f"bn{number}", nn.BatchNorm2d(channels))
        self.downsample: nn.Module | None = None
        if f"{name}.downsample.0.weight" in weights:
            channels, before = shape_of(weights, f"{name}.downsample.0.weight", 4)[:2]
            shortcut = nn.Conv2d(before, channels, 1, stride, bias=False)
            self.downsample = nn.Sequential(shortcut, nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        found = x
        for number in range(1, self.count + 1):
            found = getattr(self, f"bn{number}")(getattr(self, f"conv{number}")(found))
            found = found.relu() if number < self.count else found
        return torch.relu(found + (x if self.downsample is None else self.downsample(x)))


def resnet(weights: Weights, prefix: str, *, named: bool, groups: int) -> nn.Sequential:
    """A ResNet without its classifier, of as many groups of blocks.

    Args:
        named: with torchvision's names (``layer1``); else numbered, as a ``Sequential`` of its parts.
    """
    first = "conv1" if named else "0"
    channels = shape_of(weights, f"{prefix}{first}.weight", 4)[0]
    parts: list[nn.Module] = [
        nn.Conv2d(3, channels, 7, 2, 3, bias=False),
        nn.BatchNorm2d(channels),
        nn.ReLU(),
        nn.MaxPool2d(3, 2, 1),
    ]
    for group in range(groups):
        name = f"{prefix}{f'layer{group + 1}' if named else group + 4}"
        count = count_of(weights, f"{name}.", ".conv1.weight")
        stride = 1 if group == 0 else 2
        blocks = [ResidualBlock(weights, f"{name}.{at}", 1 if at else stride) for at in range(count)]
        parts.append(nn.Sequential(*blocks))
    names = ["conv1", "bn1", "relu", "maxpool", *(f"layer{group + 1}" for group in range(groups))]
    numbered = [str(number) for number in range(len(parts))]
    return nn.Sequential(OrderedDict(zip(names if named else numbered, parts, strict=True)))


def vgg16(weights: Weights, prefix: str) -> nn.Sequential:
    """VGG-16 up to conv5_3, not rectified, numbered as torchvision's ``features``."""
    parts: list[nn.Module] = []
    channels = 3
    for count in BLOCKS:
        for _ in range(count):
            after = shape_of(weights, f"{prefix}{len(parts)}.weight", 4)[0]
            parts += [nn.Conv2d(channels, after, 3, padding=1), nn.ReLU()]
            channels = after
        parts.append(nn.MaxPool2d(2, 2))
    return nn.Sequential(*parts[:-2])


# DINOv2


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:  # 1 x N x D
        count, width = x.shape[1:]
        parts = self.qkv(x).reshape(1, count, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        found = scaled_dot_product_attention(parts[0], parts[1], parts[2])
        return self.proj(found.transpose(1, 2).reshape(1, count, width))


class _Scale(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class _Mlp(nn.Module):
    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, hidden), nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(nn.functional.gelu(self.fc1(x)))


class _GatedMlp(nn.Module):
    """That of the largest DINOv2."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.w12, self.w3 = nn.Linear(width, 2 * hidden), nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        gate, value = self.w12(x).chunk(2, dim=-1)
        return self.w3(silu(gate) * value)


class _RectifiedConvolution(nn.Module):
    def __init__(self, weights: Weights, name: str) -> None:
        super().__init__()
        channels, before, kernel = shape_of(weights, f"{name}.conv.weight", 4)[:3]
        self.conv = nn.Conv2d(before, channels, kernel, padding=kernel // 2)
        self.bn = nn.BatchNorm2d(channels, eps=1e-3)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.bn(self.conv(x)))


class Adapter(nn.Module):
    """CricaVPR's: convolutions of three sizes over the patches, between two linear layers."""

    def __init__(self, weights: Weights, name: str, grid: tuple[int, int]) -> None:
        super().__init__()
        self.grid = grid
        narrow, wide = shape_of(weights, f"{name}.D_fc1.weight", 2)
        self.D_fc1, self.D_fc2 = nn.Linear(wide, narrow), nn.Linear(narrow, wide)
        self.branch1 = _RectifiedConvolution(weights, f"{name}.branch1")
        self.branch2, self.branch3 = (
            nn.Sequential(*(_RectifiedConvolution(weights, f"{name}.{branch}.{at}") for at in range(2)))
            for branch in ("branch2", "branch3")
        )

    def forward(self, x: Tensor) -> Tensor:  # 1 x N x D
        inside = torch.relu(self.D_fc1(x))
        maps = inside[:, 1:].transpose(1, 2).reshape(1, inside.shape[2], *self.grid)
        seen = torch.cat([self.branch1(maps), self.branch2(maps), self.branch3(maps)], dim=1)
        tokens = torch.cat([inside[:, :1], seen.flatten(2).transpose(1, 2)], dim=1)
        return self.D_fc2(tokens + inside)


class _Block(nn.Module):
    def __init__(self, weights: Weights, name: str, width: int, grid: tuple[int, int]) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(width, eps=1e-6), nn.LayerNorm(width, eps=1e-6)
        self.attn = _Attention(width, width // HEAD)
        self.ls1, self.ls2 = _Scale(width), _Scale(width)
        if f"{name}.mlp.w3.weight" in weights:
            self.mlp: nn.Module = _GatedMlp(width, shape_of(weights, f"{name}.mlp.w3.weight", 2)[1])
        else:
            self.mlp = _Mlp(width, shape_of(weights, f"{name}.mlp.fc1.weight", 2)[0])
        if f"{name}.adapter.D_fc1.weight" in weights:
            self.adapter = Adapter(weights, f"{name}.adapter", grid)
        self.adapted = hasattr(self, "adapter")

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        seen = self.norm2(x)
        found = self.mlp(seen)
        if self.adapted:
            found = found + ADAPTED * self.adapter(seen)
        return x + self.ls2(found)


class _Patches(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, PATCH, PATCH)

    def forward(self, images: Tensor) -> Tensor:
        return self.proj(images).flatten(2).transpose(1, 2)


class Dino(nn.Module):
    """DINOv2, a ViT of patches of 14 pixels: 1 x 3 x H x W to tokens, 1 x (1 + N) x D, the class token first.

    Args:
        grid: rows and columns of patches, for which the positions are scaled once.
    """

    def __init__(self, weights: Weights, prefix: str, grid: tuple[int, int]) -> None:
        super().__init__()
        _, places, width = shape_of(weights, f"{prefix}pos_embed", 3)
        self.side = round((places - 1) ** 0.5)
        if width % HEAD or self.side**2 + 1 != places:
            raise InvalidModel(f"The file's {prefix}pos_embed of {places} x {width} is not that of DINOv2.")
        self.width, self.grid = width, grid
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.mask_token = nn.Parameter(torch.zeros(1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, places, width))
        self.patch_embed = _Patches(width)
        count = count_of(weights, f"{prefix}blocks.", ".norm1.weight")
        self.blocks = nn.ModuleList(_Block(weights, f"{prefix}blocks.{at}", width, grid) for at in range(count))
        self.norm = nn.LayerNorm(width, eps=1e-6)

    def positions(self) -> Tensor:
        """The positions at the size of the grid, 1 x (1 + N) x D."""
        if self.grid == (self.side, self.side):
            return self.pos_embed
        square = self.pos_embed[:, 1:].reshape(1, self.side, self.side, self.width).permute(0, 3, 1, 2)
        scale = tuple((side + OFFSET) / self.side for side in self.grid)
        scaled = interpolate(square, scale_factor=scale, mode="bicubic")
        return torch.cat([self.pos_embed[:, :1], scaled.flatten(2).transpose(1, 2)], dim=1)

    def embed(self, images: Tensor) -> Tensor:
        """The tokens before the first block."""
        return torch.cat([self.cls_token, self.patch_embed(images)], dim=1) + self.positions()

    def forward(self, images: Tensor) -> Tensor:
        x = self.embed(images)
        for block in self.blocks:
            x = block(x)
        return x

    def maps(self, tokens: Tensor) -> Tensor:
        """The patches' tokens as a map, 1 x D x X x Y."""
        return tokens[:, 1:].transpose(1, 2).reshape(1, self.width, *self.grid)
