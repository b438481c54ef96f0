"""Fix-Context: NetVLAD whose assignment is reweighted by the surroundings of each position.

Kim, Dunn, Frahm: Learned Contextual Feature Reweighting for Image Geo-Localization, CVPR 2017.  The weights come
from three windows of fixed size.

The file is the authors' ``.caffemodel``.  VGG-16's layers are ``conv1_1_v`` … ``conv5_3_v``; the windows
``rw_conv6/single`` (5 x 5), ``single_2`` (3 x 3) and ``single_3`` (7 x 7), their sum ``rw_map/single``, the filter
``upsample``; NetVLAD's assignment ``vlad_conv`` [K, D, 1, 1] and centres ``vlad_core`` [K, D], sign changed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, conv_transpose2d

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition, Pixels
from core.networks.torch_network import TorchNetwork
from lab.baselines.netvlad import HEIGHT, WIDTH, NetVladLayer
from lab.baselines.system import About, Array, Resources, VectorSystem
from lab.baselines.trunks.vgg import CONVOLUTIONS, IMAGENET_BGR, LAST, forward, load_vgg16
from lab.conversion.caffemodel import CaffeLayer, read_caffemodel
from lab.conversion.checkpoints import as_float

ABOUT = About(
    "fix-context",
    "Fix-Context",
    "Kim, Dunn, Frahm: Learned Contextual Feature Reweighting for Image Geo-Localization, CVPR 2017",
    {"network": "VGG-16", "input": (HEIGHT, WIDTH), "windows": (3, 5, 7), "words": 64},
    weights=(
        "the VGG-16 .caffemodel of the contextual reweighting network with NetVLAD, published by its authors "
        "(hyojinie/crn, trained models)."
    ),
)


@dataclass(frozen=True)
class FixedContext:
    """The reweighting network: a weight for each position from its surroundings in three windows.

    windows: weights [C, D, k, k] and biases [C] of the windows.
    summing: [1, ΣC, 1, 1] and [1].
    enlarging: [1, 1, 4, 4], the bilinear filter that undoes the pooling.
    """

    windows: tuple[tuple[Tensor, Tensor], ...]
    summing: tuple[Tensor, Tensor]
    enlarging: Tensor

    def __call__(self, maps: Tensor) -> Tensor:
        """conv5_3 [D, X, Y] of even sides, not rectified, to the mask [X, Y], never negative."""
        small = avg_pool2d(maps[None], 3, 2, ceil_mode=True)
        contexts = [conv2d(small, weight, bias, padding=weight.shape[-1] // 2).relu() for weight, bias in self.windows]
        weights = conv2d(torch.cat(contexts, 1), *self.summing).relu()
        return conv_transpose2d(weights, self.enlarging, stride=2, padding=1)[0, 0]

    def tensors(self) -> dict[str, Tensor]:
        """All its tensors, by name."""
        named = {f"context.{i}.{j}": tensor for i, pair in enumerate(self.windows) for j, tensor in enumerate(pair)}
        return named | {f"summing.{i}": tensor for i, tensor in enumerate(self.summing)} | {"enlarging": self.enlarging}


class FixContext(VectorSystem):
    """NetVLAD whose soft assignment is multiplied by the mask (Kim et al., equation 3); scores are cosines."""

    def __init__(self, about: About, network: TorchNetwork, context: FixedContext, layer: NetVladLayer) -> None:
        from core.networks.torch_network import tensors_digest

        tensors = network.tensors() | context.tensors() | layer.tensors()
        super().__init__(about, weights=tensors_digest(tensors))
        self.network, self.context, self.layer = network, context, layer

    @torch.inference_mode()
    def vector(self, pixels: Pixels) -> Array:
        (maps,) = forward(self.network, pixels)
        return self.layer(maps, self.context(maps)).numpy()


def build(about: About, resources: Resources) -> FixContext:
    return FixContext(about, *load_fix_context(resources.file()))


def load_fix_context(path: Path) -> tuple[TorchNetwork, FixedContext, NetVladLayer]:
    """VGG-16, the reweighting network and the NetVLAD layer of the authors' file.

    Raises:
        InvalidModel: the file cannot be read, or a layer is missing or does not fit.
    """
    layers = {layer.name: layer for layer in read_caffemodel(path).layers}

    def read(name: str, *shapes: tuple[int | None, ...]) -> list[Tensor]:
        return _arrays(layers.get(name), f"{path.name}: the layer {name}", *shapes)

    vgg: dict[str, Tensor] = {}
    for name in CONVOLUTIONS:
        vgg[f"{name}.weight"], vgg[f"{name}.bias"] = read(f"{name}_v", (None, None, 3, 3), (None,))
    depth = len(vgg[f"{LAST}.bias"])
    shown = InputDefinition(height=HEIGHT, width=WIDTH, mean=IMAGENET_BGR)
    network = load_vgg16(vgg, shown, rectified=False, ceil=True)
    windows = []
    for name, side in (("rw_conv6/single", 5), ("rw_conv6/single_2", 3), ("rw_conv6/single_3", 7)):
        weight, bias = read(name, (None, depth, side, side), (None,))
        windows.append((weight, bias))
    count = sum(len(bias) for _, bias in windows)
    summing, offset = read("rw_map/single", (1, count, 1, 1), (1,))
    (enlarging,) = read("upsample", (1, 1, 4, 4))
    (assignment,) = read("vlad_conv", (None, depth, 1, 1))
    (negated,) = read("vlad_core", (len(assignment), depth))
    layer = NetVladLayer(assignment[:, :, 0, 0], torch.zeros(len(assignment)), -negated)
    return network, FixedContext(tuple(windows), (summing, offset), enlarging), layer


def _arrays(layer: CaffeLayer | None, what: str, *shapes: tuple[int | None, ...]) -> list[Tensor]:
    """The arrays of a layer, checked against these shapes; the oldest files put dimensions of length 1 before them."""
    arrays = [] if layer is None else layer.arrays()
    if len(arrays) != len(shapes):
        raise InvalidModel(f"{what} has {len(arrays)} arrays of weights, not {len(shapes)}.")
    return [
        as_float(torch.from_numpy(_without_ones(array, len(shape))), what, *shape)
        for array, shape in zip(arrays, shapes, strict=True)
    ]


def _without_ones(array: Array, sides: int) -> Array:
    while array.ndim > sides and array.shape[0] == 1:
        array = array[0]
    return array
