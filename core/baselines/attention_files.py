"""The files of the systems with attention.

Fix-Context: the authors' ``.caffemodel``.  VGG-16's layers are ``conv1_1_v`` … ``conv5_3_v``; the windows
``rw_conv6/single`` (5 x 5), ``single_2`` (3 x 3) and ``single_3`` (7 x 7), their sum ``rw_map/single``, the filter
``upsample``; NetVLAD's assignment ``vlad_conv`` [K, D, 1, 1] and centres ``vlad_core`` [K, D], sign changed.

Attentive Attention: the checkpoint of DeLF-pytorch.  ``base`` is torchvision's ResNet-50 as ``core.networks.resnet``
tells, ``attn.conv1`` and ``attn.conv2`` the two layers of the attention.  Its frames go from 0 to 1, RGB.

Context Flexible Attention: nobody publishes its weights, and the thesis tells the network only in outline: contexts
of several sizes, three late layers, a mask on 512 x 14 x 14 values.  The layout is therefore our own, a safetensors
file or PyTorch state_dict with

* ``conv1_1.weight``, ``conv1_1.bias`` … ``conv5_3.bias``: VGG-16, for BGR pixels less ImageNet's mean;
* ``context.<layer>.<i>.weight`` [C, D, k, k] with odd k and ``.bias`` [C], for conv5_1, conv5_2, conv5_3, i from 0;
* ``score.<layer>.weight`` [1, ΣC, 1, 1] and ``.bias`` [1]; ``fusion.weight`` [1, 3, 1, 1] and ``.bias`` [1].

Sizes and numbers of windows are those of the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from core.baselines.attention import (
    CONTEXT_LAYERS,
    SIDE,
    AttendedSum,
    Attention,
    FixedContext,
    FlexibleContext,
    MaskedMaps,
    ReweightedVlad,
)
from core.baselines.maps import Array
from core.baselines.netvlad import HEIGHT, WIDTH, NetVladLayer
from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition
from core.networks.caffemodel import CaffeLayer, read_caffemodel
from core.networks.checkpoints import as_float, read_checkpoint, under
from core.networks.resnet import ResNet50
from core.networks.vgg import CONVOLUTIONS, IMAGENET_BGR, LAST, load_vgg16

MAX_WINDOWS = 16
"""Of one layer."""


# Fix-Context


def load_fix_context(path: Path) -> ReweightedVlad:
    """The authors' network.

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
    return ReweightedVlad(network, FixedContext(tuple(windows), (summing, offset), enlarging), layer)


def _arrays(layer: CaffeLayer | None, what: str, *shapes: tuple[int | None, ...]) -> list[Tensor]:
    """The arrays of a layer, of just these shapes; the oldest files put sides of length 1 before them."""
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


# Attentive Attention


def load_attentive(path: Path) -> AttendedSum:
    """The network with attention of a checkpoint.

    Raises:
        InvalidModel: the file cannot be read, or a tensor is missing or does not fit.
    """
    checkpoint = read_checkpoint(path)
    try:
        network = ResNet50(under(checkpoint, "base."))
        attention = under(checkpoint, "attn.")
        hidden = _pair(attention, "conv1", None, network.channels, 1, 1)
        score = _pair(attention, "conv2", 1, len(hidden[1]), 1, 1)
    except InvalidModel as error:
        raise InvalidModel(f"{path.name} has no DELF network with attention: {error}") from error
    shown = InputDefinition(height=SIDE, width=SIDE, channel_order="rgb", mean=(0, 0, 0), scale=(1 / 255,) * 3)
    return AttendedSum(network, Attention(hidden, score), shown)


def _pair(tensors: Mapping[str, Tensor], name: str, *shape: int | None) -> tuple[Tensor, Tensor]:
    """``<name>.weight`` of a shape and ``<name>.bias`` with as many values as it has rows."""
    for kind in ("weight", "bias"):
        if f"{name}.{kind}" not in tensors:
            raise InvalidModel(f"it has no {name}.{kind}.")
    weight = as_float(tensors[f"{name}.weight"], f"{name}.weight", *shape)
    return weight, as_float(tensors[f"{name}.bias"], f"{name}.bias", len(weight))


# Context Flexible Attention


def load_context_flexible(path: Path) -> MaskedMaps:
    """A network in the layout that this module describes.

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
            _pair(tensors, f"score.{name}", 1, sum(len(bias) for _, bias in windows), 1, 1)
            for name, windows in zip(CONTEXT_LAYERS, contexts, strict=True)
        )
        fusion = _pair(tensors, "fusion", 1, len(CONTEXT_LAYERS), 1, 1)
    except InvalidModel as error:
        raise InvalidModel(f"{path.name} has no network with context flexible attention: {error}") from error
    return MaskedMaps(network, FlexibleContext(contexts, scores, fusion), tensors)


def _windows(tensors: Mapping[str, Tensor], layer: str, depth: int) -> tuple[tuple[Tensor, Tensor], ...]:
    windows = []
    for index in range(MAX_WINDOWS):
        name = f"context.{layer}.{index}"
        if index and f"{name}.weight" not in tensors:
            break
        weight, bias = _pair(tensors, name, None, depth, None, None)
        if weight.shape[2] != weight.shape[3] or weight.shape[2] % 2 == 0:
            raise InvalidModel(
                f"{name}.weight has windows of {weight.shape[2]} x {weight.shape[3]}, not odd and square."
            )
        windows.append((weight, bias))
    return tuple(windows)
