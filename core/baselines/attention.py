"""Systems that weight each place of a frame before they describe it.

Fix-Context: the contextual reweighting network (Kim, Dunn, Frahm, CVPR 2017), whose weights come from three
windows of fixed size and go into NetVLAD's assignment.  Attentive Attention: DELF (Noh, Araujo, Sim, Weyand, Han,
ICCV 2017) without its geometric verification, as the thesis compares it: local features summed by their attention.
Context Flexible Attention (Chen, Liu, Sa, Ge, Chli, RA-L 2018): the maps of conv5_3 under a mask that is fused from
contexts of several sizes in three layers.

``core.baselines.attention_files`` reads their files.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, conv_transpose2d, softplus

from core.baselines.entry import Entry, Ingredients, system_identity
from core.baselines.netvlad import HEIGHT, WIDTH, NetVladLayer, unit_rows
from core.baselines.system import About, Description, Index, InnerProducts, stack
from core.frames.preprocessing import InputDefinition, Pixels, prepare
from core.networks.network import ShallowNetwork
from core.networks.resnet import ResNet50
from core.networks.vgg import forward

SIDE = 224
"""Of the square input of the two later systems, in pixels: conv5 is then 14 x 14, as the thesis says (4.3)."""

CONTEXT_LAYERS = ("conv5_1", "conv5_2", "conv5_3")

FIX_CONTEXT = About(
    "fix-context",
    "Fix-Context",
    "Kim, Dunn, Frahm: Learned Contextual Feature Reweighting for Image Geo-Localization, CVPR 2017",
    {"network": "VGG-16", "input": (HEIGHT, WIDTH), "windows": (3, 5, 7), "words": 64},
    weights=(
        "the VGG-16 .caffemodel of the contextual reweighting network with NetVLAD, published by its authors "
        "(hyojinie/crn, trained models)."
    ),
)
ATTENTIVE = About(
    "attentive-attention",
    "Attentive Attention",
    "Noh, Araujo, Sim, Weyand, Han: Large-Scale Image Retrieval with Attentive Deep Local Features, ICCV 2017",
    {"network": "ResNet-50", "layer": "conv4_x", "input": (SIDE, SIDE), "pooling": "attention-weighted sum"},
    weights=(
        "a checkpoint bestshot.pth.tar of the attention's training, such as DeLF-pytorch (nashory/DeLF-pytorch) writes."
    ),
)
CONTEXT_FLEXIBLE = About(
    "context-flexible-attention",
    "Context Flexible Attention",
    "Chen, Liu, Sa, Ge, Chli: Learning Context Flexible Attention Model for Long-Term Visual Place Recognition, "
    "IEEE RA-L 3(4), 2018",
    {"network": "VGG-16", "layers": CONTEXT_LAYERS, "input": (SIDE, SIDE), "values": "conv5_3 under the mask"},
    weights=(
        "a safetensors file in the layout that core/baselines/attention_files.py describes; no weights of it are "
        "published, so they must come from a training of one's own."
    ),
)


# Fix-Context


@dataclass(frozen=True)
class FixedContext:
    """The reweighting network: a weight for each place from its surroundings in three windows.

    windows: weights [C, D, k, k] and biases [C] of the windows.
    summing: [1, ΣC, 1, 1] and [1].
    enlarging: [1, 1, 4, 4], the bilinear filter that undoes the pooling.
    """

    windows: tuple[tuple[Tensor, Tensor], ...]
    summing: tuple[Tensor, Tensor]
    enlarging: Tensor

    def __call__(self, maps: Tensor) -> Tensor:
        """conv5_3 [D, X, Y] of even sides, not rectified, to the mask [X, Y], which is never negative."""
        small = avg_pool2d(maps[None], 3, 2, ceil_mode=True)
        contexts = [conv2d(small, weight, bias, padding=weight.shape[-1] // 2).relu() for weight, bias in self.windows]
        weights = conv2d(torch.cat(contexts, 1), *self.summing).relu()
        return conv_transpose2d(weights, self.enlarging, stride=2, padding=1)[0, 0]

    def tensors(self) -> dict[str, Tensor]:
        """What it is made of, by name."""
        named = {f"context.{i}.{j}": tensor for i, pair in enumerate(self.windows) for j, tensor in enumerate(pair)}
        return named | {f"summing.{i}": tensor for i, tensor in enumerate(self.summing)} | {"enlarging": self.enlarging}


@dataclass(frozen=True)
class ReweightedVlad:
    """NetVLAD whose soft assignment is multiplied by the mask (Kim et al., equation 3)."""

    network: ShallowNetwork
    context: FixedContext
    layer: NetVladLayer

    def __call__(self, pixels: Pixels) -> Tensor:
        (maps,) = forward(self.network, pixels)
        return self.layer(maps, self.context(maps))

    def tensors(self) -> dict[str, Tensor]:
        return self.network.weights() | self.context.tensors() | self.layer.tensors()


# Attentive Attention


@dataclass(frozen=True)
class Attention:
    """Two layers of 1 x 1 convolutions: weights [H, D, 1, 1], [H], [1, H, 1, 1], [1]."""

    hidden: tuple[Tensor, Tensor]
    score: tuple[Tensor, Tensor]

    def __call__(self, maps: Tensor) -> Tensor:
        """Maps [B, D, X, Y] to the attention [B, 1, X, Y], which is always positive (Noh et al., section 3.2)."""
        return softplus(conv2d(conv2d(maps, *self.hidden).relu(), *self.score))


@dataclass(frozen=True)
class AttendedSum:
    """y = Σ_n α(f_n)·f_n (Noh et al., equation 1) over features of unit length; y of unit length."""

    network: ResNet50
    attention: Attention
    shown: InputDefinition

    def __call__(self, pixels: Pixels) -> Tensor:
        image = torch.from_numpy(np.ascontiguousarray(prepare(pixels, self.shown))).permute(2, 0, 1)[None]
        maps = self.network(image)
        weighted = torch.nn.functional.normalize(maps, dim=1) * self.attention(maps)
        return unit_rows(weighted.sum((2, 3)))[0]

    def tensors(self) -> dict[str, Tensor]:
        pairs = {"hidden": self.attention.hidden, "score": self.attention.score}
        named = {f"attention.{name}.{i}": tensor for name, pair in pairs.items() for i, tensor in enumerate(pair)}
        return self.network.tensors | named


# Context Flexible Attention


@dataclass(frozen=True)
class FlexibleContext:
    """A mask from contexts of several sizes in several layers, so that it can take any shape.

    contexts: for each layer, weights [C, D, k, k] and biases [C] of its windows.
    scores: for each layer, [1, ΣC, 1, 1] and [1]: the layer's own map.
    fusion: [1, L, 1, 1] and [1]: the weights of the layers' maps.
    """

    contexts: tuple[tuple[tuple[Tensor, Tensor], ...], ...]
    scores: tuple[tuple[Tensor, Tensor], ...]
    fusion: tuple[Tensor, Tensor]

    def __call__(self, layers: Sequence[Tensor]) -> Tensor:
        """Rectified maps [D, X, Y] of each layer to the mask [X, Y], which is always positive."""
        found = []
        for maps, windows, score in zip(layers, self.contexts, self.scores, strict=True):
            seen = [conv2d(maps[None], weight, bias, padding=weight.shape[-1] // 2).relu() for weight, bias in windows]
            found.append(conv2d(torch.cat(seen, 1), *score))
        return softplus(conv2d(torch.cat(found, 1), *self.fusion))[0, 0]


@dataclass(frozen=True)
class MaskedMaps:
    """conv5_3 under the mask, flattened: [D·X·Y] of unit length."""

    network: ShallowNetwork
    context: FlexibleContext
    read: dict[str, Tensor]
    """The tensors of the file that are in use."""

    def __call__(self, pixels: Pixels) -> Tensor:
        layers = forward(self.network, pixels)
        return unit_rows((layers[-1] * self.context(layers)).reshape(1, -1))[0]

    def tensors(self) -> dict[str, Tensor]:
        return self.read


# All three


class Describer(Protocol):
    """A frame to one vector of unit length."""

    def __call__(self, pixels: Pixels) -> Tensor: ...

    def tensors(self) -> dict[str, Tensor]:
        """All weights in use, by name."""


class Attended:
    """One vector a frame; scores are cosines."""

    sequential = False

    def __init__(self, about: About, describer: Describer) -> None:
        from core.networks.identity import tensors_digest

        self.about, self.describer = about, describer
        self.identity = system_identity(about, weights=tensors_digest(describer.tensors()))

    @torch.inference_mode()
    def describe(self, pixels: Pixels) -> Description:
        began = time.perf_counter()
        vector = self.describer(pixels).numpy()
        return Description({"descriptor": vector}, {"forward": 1e3 * (time.perf_counter() - began)})

    def index(self, references: Sequence[Description]) -> Index:
        return InnerProducts(stack(references))


def build_fix_context(ingredients: Ingredients) -> Attended:
    from core.baselines.attention_files import load_fix_context

    return Attended(FIX_CONTEXT, load_fix_context(ingredients.file()))


def build_attentive(ingredients: Ingredients) -> Attended:
    from core.baselines.attention_files import load_attentive

    return Attended(ATTENTIVE, load_attentive(ingredients.file()))


def build_context_flexible(ingredients: Ingredients) -> Attended:
    from core.baselines.attention_files import load_context_flexible

    return Attended(CONTEXT_FLEXIBLE, load_context_flexible(ingredients.file()))


SYSTEMS: tuple[Entry, ...] = (
    Entry(FIX_CONTEXT, build_fix_context),
    Entry(ATTENTIVE, build_attentive),
    Entry(CONTEXT_FLEXIBLE, build_context_flexible),
)
