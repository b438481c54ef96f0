"""Activations of one layer of a convolutional network as the description of a frame.

AlexNet: conv3, by the cosine (Sünderhauf, Shirazi, Dayoub, Upcroft, Milford: On the Performance of ConvNet
Features for Place Recognition, IROS 2015).  AMOSNet and HybridNet: conv5 pooled in a spatial pyramid (Chen et al.:
Deep Learning Features at Scale for Visual Place Recognition, ICRA 2017), by the sum of absolute differences, as
VPR-Bench (Zaffar et al., IJCV 2021) made the published figures.  Places365: the fully connected fc7 of the network
trained on scenes (Zhou et al., TPAMI 2018), by the cosine, as the thesis compares it (section 4.4).

All read Caffe's files: the ``.caffemodel`` with its mean file beside it, or for the first three a network file that
was imported before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from core.errors import InvalidModel, MissingWeights
from core.frames.preprocessing import Pixels, prepare
from core.method.catalogue import NETWORK_SUFFIX
from core.method.features import FeatureDefinition, FeatureExtractor
from core.networks.network import NetworkDefinition, Relu
from core.networks.torch_network import TorchNetwork, build_layer, load_torch_network
from lab.baselines.pooling import LEVELS, MapsSystem, PooledSystem, flatten, spatial_pyramid_pool
from lab.baselines.system import (
    About,
    Array,
    Constants,
    Description,
    ReferenceIndex,
    Resources,
    VectorSystem,
    stack,
    unit,
)
from lab.conversion.caffe import import_caffe
from lab.conversion.caffemodel import CaffeLayer, read_caffemodel

SIDE = 227
"""Of the square input of AlexNet and its kin, in pixels."""

VGG_SIDE = 224

IMAGENET_MEAN = (104.00699, 116.66877, 122.67892)
"""The mean that Caffe publishes for ImageNet, BGR."""


@dataclass(frozen=True)
class PublishedMean:
    """How the mean of a network is published: the names of its file, or the values themselves, BGR."""

    means: tuple[str, ...]
    mean: tuple[float, float, float] | None = None


# The files


def mean_file(model: Path, names: Sequence[str]) -> Path | None:
    """The mean file in the folder of a model: the first of ``names`` that is there, in any case of letters."""
    present = {path.name.lower(): path for path in sorted(model.parent.iterdir())}
    return next((present[name.lower()] for name in names if name.lower() in present), None)


def import_published(model: Path, published: PublishedMean, side: int) -> tuple[NetworkDefinition, dict[str, Tensor]]:
    """The convolutional trunk of a published ``.caffemodel``, for an input of ``side`` x ``side`` pixels.

    Its mean is that of a mean file beside it, else that which the model itself names, else the published one.

    Raises:
        MissingWeights: nothing says the mean of the channels.
        InvalidModel: a file cannot be used.
    """
    stem = f"{model.stem}_mean"
    names = [f"{stem}.npy", f"{stem}.binaryproto", *published.means]
    mean: Path | tuple[float, float, float] | None = mean_file(model, names)
    if mean is None and not any("mean" in layer.part("transform") for layer in read_caffemodel(model).layers):
        mean = published.mean
        if mean is None:
            raise MissingWeights(f"{model.name} needs its mean file too; put it beside it as {' or '.join(names)}.")
    return import_caffe(model, mean, input_size=(side, side))


def load_trunk(path: Path, layer: str, published: PublishedMean) -> TorchNetwork:
    """The network of a ``.caffemodel``, or of a network file that was imported before, as deep as ``layer``."""
    if path.name.endswith(NETWORK_SUFFIX):
        return load_torch_network(path, (layer,))
    definition, weights = import_published(path, published, SIDE)
    network = TorchNetwork(definition, (layer,))
    network.load_weights(weights)
    return network.eval().requires_grad_(False).to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def _extractor(path: Path, layer: str, published: PublishedMean) -> FeatureExtractor:
    # Only the maps are read, so what the definition says of regions is never used.
    definition = FeatureDefinition(layers=(layer,), regions=1, steps=(1.0,), unit_features=False)
    return FeatureExtractor(load_trunk(path, layer, published).as_data(), definition)


# AlexNet


ALEXNET = About(
    "alexnet",
    "AlexNet",
    "Sünderhauf, Shirazi, Dayoub, Upcroft, Milford: On the Performance of ConvNet Features for Place Recognition, "
    "IROS 2015",
    {"layer": "conv3", "input": (SIDE, SIDE), "distance": "cosine"},
    weights="bvlc_alexnet.caffemodel of Caffe's model zoo.",
)


def build_alexnet(about: About, resources: Resources) -> PooledSystem:
    published = PublishedMean(("ilsvrc_2012_mean.npy", "imagenet_mean.binaryproto"), IMAGENET_MEAN)
    return PooledSystem(about, _extractor(resources.file(), "conv3", published), flatten)


# AMOSNet and HybridNet


_PYRAMID: Constants = {
    "layer": "conv5",
    "input": (SIDE, SIDE),
    "levels": LEVELS,
    "distance": "sum of absolute differences",
}
_CHEN = (
    "Chen, Jacobson, Sünderhauf, Upcroft, Liu, Shen, Reid, Milford: Deep Learning Features at Scale for Visual Place "
)
AMOSNET = About(
    "amosnet",
    "AMOSNet",
    f"{_CHEN}Recognition, ICRA 2017",
    _PYRAMID,
    weights="the authors' AmosNet.caffemodel with its mean file amosnet_mean.npy beside it.",
)
HYBRIDNET = About(
    "hybridnet",
    "HybridNet",
    f"{_CHEN}Recognition, ICRA 2017",
    _PYRAMID,
    weights="the authors' HybridNet.caffemodel with its mean file (hybridnet_mean.npy or amosnet_mean.npy) beside it.",
)

SCALE = 256 * 256
"""VPR-Bench's divisor of the sum of differences; it changes no order."""


@dataclass(frozen=True)
class Differences:
    """Scores 1 - Σ|q - r| / 256²: float32 [R, D] references."""

    vectors: Array

    def score(self, queries: Sequence[Description]) -> Array:
        queried, known = torch.from_numpy(stack(queries)), torch.from_numpy(self.vectors)
        return np.asarray(1 - torch.cdist(queried, known, p=1).numpy() / SCALE, np.float32)


class Pyramid(MapsSystem):
    """conv5 pooled to 30 maxima a channel."""

    def keep(self, maps: list[Array]) -> dict[str, Array]:
        return {"descriptor": spatial_pyramid_pool(*maps)}

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return Differences(stack(references))


def build_pyramid(about: About, resources: Resources) -> Pyramid:
    published = PublishedMean((f"{about.name}_mean.npy", "amosnet_mean.npy"))
    return Pyramid(about, _extractor(resources.file(), "conv5", published))


# Places365


PLACES365 = About(
    "places365",
    "Places365",
    "Zhou, Lapedriza, Khosla, Oliva, Torralba: Places: A 10 Million Image Database for Scene Recognition, TPAMI 2018",
    {"layer": "fc7", "distance": "cosine"},
    weights=(
        "alexnet_places365.caffemodel or vgg16_places365.caffemodel (CSAILVision/places365) "
        "with places365CNN_mean.binaryproto beside it."
    ),
)
FULLY_CONNECTED = ("fc6", "fc7")


class Places365(VectorSystem):
    """The rectified fc7 of one frame, of unit length; scores are cosines."""

    def __init__(self, about: About, path: Path) -> None:
        from core.networks.identity import json_digest
        from core.networks.torch_network import tensors_digest

        layers = {layer.name: layer for layer in read_caffemodel(path).layers}
        side = VGG_SIDE if "conv5_3" in layers else SIDE
        definition, weights = import_published(path, PublishedMean(("places365CNN_mean.binaryproto",)), side)
        trunk = definition.convolutions()[-1].name
        self._trunk = TorchNetwork(definition, (trunk,))
        self._trunk.load_weights(weights)
        self._trunk.eval().requires_grad_(False)
        self._head = _head(definition, layers, path.name)
        shown = self._trunk.input
        blank = torch.zeros(1, 3, shown.height, shown.width)
        try:
            self._fc7(blank)
        except RuntimeError as error:
            raise InvalidModel(f"{path.name}: fc6 does not fit the maps that come before it: {error}") from error
        tensors = weights | {f"head.{name}": tensor for name, tensor in self._head.state_dict().items()}
        digests = {"network": json_digest(definition.model_dump(mode="json")), "weights": tensors_digest(tensors)}
        super().__init__(about, **digests)

    @torch.inference_mode()
    def _fc7(self, images: Tensor) -> Tensor:
        found: Tensor = self._head(self._trunk(images)[0])
        return found[0]

    def vector(self, pixels: Pixels) -> Array:
        image = torch.from_numpy(prepare(pixels, self._trunk.input)).permute(2, 0, 1)[None]
        return unit(self._fc7(image).numpy())


def _head(definition: NetworkDefinition, layers: dict[str, CaffeLayer], what: str) -> nn.Sequential:
    """The layers after the last convolution: its pooling, then the fully connected layers, each rectified."""
    last = definition.convolutions()[-1]
    behind = definition.layers[definition.layers.index(last) + 1 :]
    modules = [build_layer(layer, last.channels) for layer in behind if not isinstance(layer, Relu)]
    modules.append(nn.Flatten())
    for name in FULLY_CONNECTED:
        arrays = layers[name].arrays() if name in layers and layers[name].type == "InnerProduct" else []
        if len(arrays) != 2 or arrays[1].size != arrays[0].shape[-2]:
            raise InvalidModel(f"{what} has no fully connected layer {name} with weights and biases.")
        count, values = arrays[0].shape[-2:]  # the oldest files write 1 x 1 x count x values
        linear = nn.Linear(values, count)
        with torch.no_grad():
            linear.weight.copy_(torch.from_numpy(arrays[0].reshape(count, values)))
            linear.bias.copy_(torch.from_numpy(arrays[1].reshape(-1)))
        modules += [linear, nn.ReLU()]
    return nn.Sequential(*modules).eval().requires_grad_(False)


def build_places365(about: About, resources: Resources) -> Places365:
    return Places365(about, resources.file())
