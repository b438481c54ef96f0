"""The teacher: MobileNetV1 (Howard et al., 2017), ImageNet weights with batch norm folded.

The weights are read from an ``.npz`` of plain arrays and are never part of this project.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

# (block, stride of its depthwise convolution), up to the deepest layer that is used.
BLOCKS = (
    ("2_1", 1), ("2_2", 2), ("3_1", 1), ("3_2", 2), ("4_1", 1), ("4_2", 2),
    ("5_1", 1), ("5_2", 1), ("5_3", 1), ("5_4", 1), ("5_5", 1),
)  # fmt: skip
MEAN = (103.94, 116.78, 123.68)
SCALE = 0.017


class Teacher(nn.Module):
    """MobileNetV1 down to conv5_5; returns the outputs of conv5_1 and conv5_5.

    Args:
        path: an ``.npz`` with ``conv1/W|b`` and ``conv{block}_{dw,sep}/W|b``.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        with np.load(path, allow_pickle=False) as arrays:
            self.stem = _convolution(arrays["conv1/W"], arrays["conv1/b"], stride=2, pad=1, groups=1)
            self.blocks = nn.ModuleDict()
            for block, stride in BLOCKS:
                depthwise, pointwise = arrays[f"conv{block}_dw/W"], arrays[f"conv{block}_sep/W"]
                self.blocks[block] = nn.Sequential(
                    _convolution(
                        depthwise.reshape(-1, 1, 3, 3), arrays[f"conv{block}_dw/b"], stride, 1, len(depthwise)
                    ),
                    nn.ReLU(inplace=True),
                    _convolution(pointwise.reshape(*pointwise.shape[:2], 1, 1), arrays[f"conv{block}_sep/b"], 1, 0, 1),
                    nn.ReLU(inplace=True),
                )
        self.mean: Tensor
        self.register_buffer("mean", torch.tensor(MEAN).view(1, 3, 1, 1))
        self.eval().requires_grad_(False)

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """B x 3 x 227 x 227 BGR in 0–255 to two maps, each B x 512 x 13 x 13.

        On a 227-pixel input the teacher's cell m is centred at pixel 16m and CaffeNet's cell at
        17 + 16m, so dropping the teacher's first and last row and column aligns the two grids to
        one pixel.  The same holds of every input of 16m + 3 pixels, which gives (m - 1) x (m - 1) cells.
        """
        x = torch.relu(self.stem((pixels - self.mean) * SCALE))
        early = x
        for block, module in self.blocks.items():
            x = module(x)
            if block == "5_1":
                early = x
        return early[:, :, 1:-1, 1:-1], x[:, :, 1:-1, 1:-1]


def _convolution(weight: np.ndarray, bias: np.ndarray, stride: int, pad: int, groups: int) -> nn.Conv2d:
    out, inner, kernel, _ = weight.shape
    module = nn.Conv2d(inner * groups, out, kernel, stride, pad, groups=groups)
    module.weight.data.copy_(torch.from_numpy(weight.astype(np.float32)))
    module.bias.data.copy_(torch.from_numpy(bias.astype(np.float32)))  # type: ignore[union-attr]
    return module
