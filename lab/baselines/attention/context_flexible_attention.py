"""Context Flexible Attention: the maps of conv5_3 under a mask that is fused from contexts of several sizes.

Chen, Liu, Sa, Ge, Chli: Learning Context Flexible Attention Model for Long-Term Visual Place Recognition, IEEE RA-L
3(4), 2018.

Nobody publishes its weights, and the thesis describes the network only in outline: contexts of several sizes, three
late layers, a mask on 512 x 14 x 14 values.  The layout is therefore our own, a safetensors file or PyTorch
state_dict with

* ``conv1_1.weight``, ``conv1_1.bias`` … ``conv5_3.bias``: VGG-16, for BGR pixels less ImageNet's mean;
* ``context.<layer>.<i>.weight`` [C, D, k, k] with odd k and ``.bias`` [C], for conv5_1, conv5_2, conv5_3, i from 0;
* ``score.<layer>.weight`` [1, ΣC, 1, 1] and ``.bias`` [1]; ``fusion.weight`` [1, 3, 1, 1] and ``.bias`` [1].

Sizes and numbers of windows are those of the file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import conv2d, softplus

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition, Pixels
from core.networks.torch_network import TorchNetwork
from lab.baselines.attention.attentive_attention import read_pair
from lab.baselines.netvlad import unit_rows
from lab.baselines.system import About, Array, Resources, VectorSystem
from lab.baselines.trunks.vgg import IMAGENET_BGR, forward, load_vgg16
from lab.conversion.checkpoints import read_checkpoint

SIDE = 224
"""Side of the square input in pixels: conv5 is then 14 x 14, as in the thesis (section 4.3)."""

CONTEXT_LAYERS = ("conv5_1", "conv5_2", "conv5_3")
MAX_WINDOWS = 16
"""Windows of one layer."""

ABOUT = About(
    "context-flexible-attention",
    "Context Flexible Attention",
    "Chen, Liu, Sa, Ge, Chli: Learning Context Flexible Attention Model for Long-Term Visual Place Recognition, "
    "IEEE RA-L 3(4), 2018",
    {"network": "VGG-16", "layers": CONTEXT_LAYERS, "input": (SIDE, SIDE), "values": "conv5_3 under the mask"},
    weights=(
        "a safetensors file in the layout that lab/baselines/attention/context_flexible_attention.py describes; no "
        "weights of it are published, so they must come from a training of one's own."
    ),
)


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
        """Rectified maps [D, X, Y] of each layer to the mask [X, Y], always positive."""
        found = []
        for maps, windows, score in zip(layers, self.contexts, self.scores, strict=True):
            seen = [conv2d(maps[None], weight, bias, padding=weight.shape[-1] // 2).relu() for weight, bias in windows]
            found.append(conv2d(torch.cat(seen, 1), *score))
        return softplus(conv2d(torch.cat(found, 1), *self.fusion))[0, 0]


class ContextFlexibleAttention(VectorSystem):
    """conv5_3 under the mask, flattened: [D·X·Y] of unit length; scores are cosines.

    Args:
        tensors: all tensors of the file that are in use, by name.
    """

    def __init__(
        self, about: About, network: TorchNetwork, context: FlexibleContext, tensors: dict[str, Tensor]
    ) -> None:
        from core.networks.torch_network import tensors_digest

        super().__init__(about, weights=tensors_digest(tensors))
        self.network, self.context = network, context

    @torch.inference_mode()
    def vector(self, pixels: Pixels) -> Array:
        layers = forward(self.network, pixels)
        return unit_rows((layers[-1] * self.context(layers)).reshape(1, -1))[0].numpy()


def build(about: About, resources: Resources) -> ContextFlexibleAttention:
    return ContextFlexibleAttention(about, *load_context_flexible(resources.file()))


def load_context_flexible(path: Path) -> tuple[TorchNetwork, FlexibleContext, dict[str, Tensor]]:
    """Network, context and all tensors in use of a file in the layout that this module describes.

    Raises:
        InvalidModel: the file cannot be read, or a tensor is missing or does not fit.
    """
    checkpoint = read_checkpoint(path)
    tensors = {
        name: checkpoint[name] for name in checkpoint if name.startswith(("conv", "context.", "score.", "fusion."))
    }
    try:
        shown = InputDefinition(height=SIDE, width=SIDE, mean=IMAGENET_BGR)
        network = load_vgg16(tensors, shown, outputs=CONTEXT_LAYERS, rectified=True)
        depths = {layer.name: layer.channels for layer in network.definition.convolutions()}
        contexts = tuple(_windows(tensors, name, depths[name]) for name in CONTEXT_LAYERS)
        scores = tuple(
            read_pair(tensors, f"score.{name}", 1, sum(len(bias) for _, bias in windows), 1, 1)
            for name, windows in zip(CONTEXT_LAYERS, contexts, strict=True)
        )
        fusion = read_pair(tensors, "fusion", 1, len(CONTEXT_LAYERS), 1, 1)
    except InvalidModel as error:
        raise InvalidModel(f"{path.name} has no network with context flexible attention: {error}") from error
    return network, FlexibleContext(contexts, scores, fusion), tensors


def _windows(tensors: Mapping[str, Tensor], layer: str, depth: int) -> tuple[tuple[Tensor, Tensor], ...]:
    windows = []
    for index in range(MAX_WINDOWS):
        name = f"context.{layer}.{index}"
        if index and f"{name}.weight" not in tensors:
            break
        weight, bias = read_pair(tensors, name, None, depth, None, None)
        if weight.shape[2] != weight.shape[3] or weight.shape[2] % 2 == 0:
            raise InvalidModel(
                f"{name}.weight has windows of {weight.shape[2]} x {weight.shape[3]}, not odd and square."
            )
        windows.append((weight, bias))
    return tuple(windows)
