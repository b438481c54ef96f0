"""Attentive Attention: local features of ResNet-50, summed by their attention.

DELF: Noh, Araujo, Sim, Weyand, Han: Large-Scale Image Retrieval with Attentive Deep Local Features, ICCV 2017;
without its geometric verification, as the thesis compares it.

The file is the checkpoint of DeLF-pytorch.  ``base`` is torchvision's ResNet-50 as ``lab.baselines.trunks.resnet``
reads it, ``attn.conv1`` and ``attn.conv2`` are the two layers of the attention.  Its input goes from 0 to 1, RGB.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, normalize, softplus

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition, Pixels, prepare
from lab.baselines.netvlad import unit_rows
from lab.baselines.system import About, Array, Resources, VectorSystem
from lab.baselines.trunks.resnet import ResNet50
from lab.conversion.checkpoints import as_float, read_checkpoint, under

SIDE = 224
"""Side of the square input in pixels."""

ABOUT = About(
    "attentive-attention",
    "Attentive Attention",
    "Noh, Araujo, Sim, Weyand, Han: Large-Scale Image Retrieval with Attentive Deep Local Features, ICCV 2017",
    {"network": "ResNet-50", "layer": "conv4_x", "input": (SIDE, SIDE), "pooling": "attention-weighted sum"},
    weights=(
        "a checkpoint bestshot.pth.tar of the attention's training, such as DeLF-pytorch (nashory/DeLF-pytorch) writes."
    ),
)


@dataclass(frozen=True)
class Attention:
    """Two layers of 1 x 1 convolutions: weights [H, D, 1, 1], [H], [1, H, 1, 1], [1]."""

    hidden: tuple[Tensor, Tensor]
    score: tuple[Tensor, Tensor]

    def __call__(self, maps: Tensor) -> Tensor:
        """Maps [B, D, X, Y] to the attention [B, 1, X, Y], which is always positive (Noh et al., section 3.2)."""
        return softplus(conv2d(conv2d(maps, *self.hidden).relu(), *self.score))

    def tensors(self) -> dict[str, Tensor]:
        """All its tensors, by name."""
        pairs = {"hidden": self.hidden, "score": self.score}
        return {f"attention.{name}.{i}": tensor for name, pair in pairs.items() for i, tensor in enumerate(pair)}


class AttentiveAttention(VectorSystem):
    """y = Σ_n α(f_n)·f_n (Noh et al., equation 1) over features of unit length; y of unit length.

    Args:
        shown: how a frame is prepared for the network.
    """

    def __init__(self, about: About, network: ResNet50, attention: Attention, shown: InputDefinition) -> None:
        from core.networks.torch_network import tensors_digest

        super().__init__(about, weights=tensors_digest(network.tensors | attention.tensors()))
        self.network, self.attention, self.shown = network, attention, shown

    @torch.inference_mode()
    def vector(self, pixels: Pixels) -> Array:
        image = torch.from_numpy(np.ascontiguousarray(prepare(pixels, self.shown))).permute(2, 0, 1)[None]
        maps = self.network(image)
        weighted = normalize(maps, dim=1) * self.attention(maps)
        return unit_rows(weighted.sum((2, 3)))[0].numpy()


def build(about: About, resources: Resources) -> AttentiveAttention:
    return AttentiveAttention(about, *load_attentive(resources.file()))


def load_attentive(path: Path) -> tuple[ResNet50, Attention, InputDefinition]:
    """Network, attention and input of a checkpoint.

    Raises:
        InvalidModel: the file cannot be read, or a tensor is missing or does not fit.
    """
    checkpoint = read_checkpoint(path)
    try:
        network = ResNet50(under(checkpoint, "base."))
        attention = under(checkpoint, "attn.")
        hidden = read_pair(attention, "conv1", None, network.channels, 1, 1)
        score = read_pair(attention, "conv2", 1, len(hidden[1]), 1, 1)
    except InvalidModel as error:
        raise InvalidModel(f"{path.name} has no DELF network with attention: {error}") from error
    shown = InputDefinition(height=SIDE, width=SIDE, channel_order="rgb", mean=(0, 0, 0), scale=(1 / 255,) * 3)
    return network, Attention(hidden, score), shown


def read_pair(tensors: Mapping[str, Tensor], name: str, *shape: int | None) -> tuple[Tensor, Tensor]:
    """``<name>.weight`` of a shape and ``<name>.bias`` with as many values as it has rows.

    Raises:
        InvalidModel: one is missing or has another shape.
    """
    for kind in ("weight", "bias"):
        if f"{name}.{kind}" not in tensors:
            raise InvalidModel(f"it has no {name}.{kind}.")
    weight = as_float(tensors[f"{name}.weight"], f"{name}.weight", *shape)
    return weight, as_float(tensors[f"{name}.bias"], f"{name}.bias", len(weight))
