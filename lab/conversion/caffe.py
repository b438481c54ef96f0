"""Importing networks from Caffe's files (Jia et al., 2014), without changing a weight.

Only the convolutional trunk is imported: convolutions, rectifiers, pooling and local response normalization, from the
input to the first inner product.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from pydantic import ValidationError
from torch import Tensor, nn

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition
from core.networks.network import Convolution, Layer, NetworkDefinition, Normalization, Pooling, Relu
from lab.conversion.caffemodel import CaffeLayer, CaffeNetwork, Part, read_caffemodel, read_mean

_TRUNK = {"Convolution", "ReLU", "Pooling", "LRN"}
_PASSED = {"Dropout", "Split"}  # change nothing when a network is run
_HEADS = {
    "Accuracy", "ArgMax", "Flatten", "HDF5Output", "InnerProduct", "Reshape", "Silence", "Softmax",
}  # fmt: skip

_DATA = ("transform", "data", "image_data")
"""Groups of parameters that say how pictures are fed to the network."""

_LAYER_NAME = re.compile(r"[A-Za-z0-9_/+-]{1,64}")
MAX_SIDE = 4096
"""Upper limit of an input, a kernel, a stride or a border, in pixels."""

MAX_CHANNELS = 65_536


def import_caffe(
    model: Path,
    mean: Path | tuple[float, float, float] | None = None,
    *,
    name: str | None = None,
    input_size: tuple[int, int] | None = None,
) -> tuple[NetworkDefinition, dict[str, Tensor]]:
    """Import the convolutional trunk of a Caffe network.

    Layers, their order and all their parameters are taken from the model's own description, as is its input size
    (``input_param``, ``input_shape``, ``input_dim``, else the crop size of its training data).

    Args:
        model: the ``.caffemodel``.
        mean: its mean file, ``.npy`` or ``.binaryproto``, or the mean of each channel in the network's order; None if
            the model has its mean values.
        name: of the definition; None: the file's name.
        input_size: height and width in pixels, if the model does not have them or others are wanted.

    Returns:
        The definition, and ``<convolution>.weight`` (K x C/groups x h x w) and ``<convolution>.bias`` (K),
        float32, for each of its convolutions.

    Raises:
        InvalidModel: a file cannot be read, or our format cannot express a part of the network exactly.
    """
    network = read_caffemodel(model)
    trunk = _find_trunk(network)
    height, width = _input_size(network) if input_size is None else input_size
    means = _named_mean(network.layers) if mean is None else read_mean(mean) if isinstance(mean, Path) else mean
    try:
        shown = InputDefinition(height=height, width=width, mean=means, scale=(_named_scale(network.layers),) * 3)
        definition = NetworkDefinition(
            name=_network_name(model) if name is None else name,
            input=shown,
            layers=tuple(_translate(layer) for layer in trunk),
        )
    except ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(str(part) for part in problem["loc"])
        raise InvalidModel(f"{model.name} makes no network of ours: {where} {problem['msg']}.") from error
    _check_sizes(definition)
    return definition, _read_weights(definition, trunk)


# Which layers


def _is_head(layer: CaffeLayer) -> bool:
    """Whether a layer's output is not a map of activations any more, or serves training only."""
    whole_map = layer.type == "Pooling" and layer.part("pooling").get("global", False)
    return layer.type in _HEADS or layer.type.endswith("Loss") or whole_map


def _find_trunk(network: CaffeNetwork) -> list[CaffeLayer]:
    """The chain of layers from the input on; layers after an inner product or a loss are left out.

    Raises:
        InvalidModel: the chain has a layer of a type that our format does not know, or forks and goes on.
    """
    trunk: list[CaffeLayer] = []
    present = set() if network.input is None else {network.input}  # names of the blob at the trunk's end
    past: set[str] = set()  # blobs of the trunk before it
    aside: set[str] = set()  # blobs that are no part of it
    for layer in network.layers:
        if not layer.bottoms and layer.type not in _TRUNK:  # data
            present.update(layer.tops[:1])
            aside.update(layer.tops[1:])
        elif _is_head(layer) or aside.intersection(layer.bottoms):
            aside.update(layer.tops)
        elif layer.type in _PASSED:
            (past if layer.bottoms[0] in past else present).update(layer.tops)
        elif layer.type not in _TRUNK:
            raise InvalidModel(f"The network's {layer} is of a type that cannot be imported.")
        elif len(layer.bottoms) != 1 or len(layer.tops) != 1:
            raise InvalidModel(f"The network's {layer} has not one input and one output.")
        elif present and layer.bottoms[0] not in present:
            raise InvalidModel(f"The network's {layer} does not follow the layer before it: the network forks.")
        else:
            trunk.append(layer)
            past = (past | present) - set(layer.tops)
            present = set(layer.tops)
    return trunk


def _network_name(model: Path) -> str:
    return re.sub(r"[^a-z0-9._-]", "-", model.stem.lower()).lstrip("._-")[:64] or "caffe"


# Inputs


def _input_size(network: CaffeNetwork) -> tuple[int, int]:
    """Height and width; the deployed network's own input comes before the crops it was trained on."""
    layers = network.layers
    shapes = [shape.get("dim", []) for layer in layers for shape in layer.part("input").get("shape", [])]
    for shape in (*shapes, network.input_shape):
        if shape:
            if len(shape) != 4 or shape[1] != 3:
                raise InvalidModel(f"The network's input is {tuple(shape[:8])}, not of 3 channels, height and width.")
            return shape[2], shape[3]
    parts = [layer.part(key) for key in _DATA for layer in layers]
    crop = next((part["crop"] for part in parts if part.get("crop")), None)
    if crop is None:
        raise InvalidModel("The model does not say its input size; give it.")
    return crop, crop


def _named_mean(layers: Sequence[CaffeLayer]) -> tuple[float, float, float]:
    found = next((layer.part("transform")["mean"] for layer in layers if "mean" in layer.part("transform")), None)
    if found is None:
        raise InvalidModel("The model does not name the mean of its channels; give its mean file.")
    if len(found) not in (1, 3):
        raise InvalidModel(f"The model names a mean of {len(found)} channels, not 3.")
    blue, green, red = np.broadcast_to(found, 3).tolist()
    return blue, green, red


def _named_scale(layers: Sequence[CaffeLayer]) -> float:
    parts = [layer.part(key) for key in _DATA for layer in layers]
    return next((part["scale"] for part in parts if "scale" in part), 1.0)


# Each layer


def _translate(layer: CaffeLayer) -> Layer:
    """The layer in our format, with Caffe's defaults for missing parameters."""
    if not _LAYER_NAME.fullmatch(layer.name) or hasattr(nn.ModuleDict(), layer.name):
        raise InvalidModel(f"The network's {layer} has a name that our format cannot bear.")
    match layer.type:
        case "Convolution":
            return _translate_convolution(layer)
        case "ReLU":
            return Relu(name=layer.name, negative_slope=_finite(layer, layer.part("relu").get("negative_slope", 0.0)))
        case "Pooling":
            return _translate_pooling(layer)
        case _:
            return _translate_normalization(layer)


def _translate_convolution(layer: CaffeLayer) -> Convolution:
    part = layer.part("convolution")
    if _side(layer, part, "dilation", 1) != 1:
        raise InvalidModel(f"The network's {layer} is dilated.")
    if part.get("axis", 1) != 1:
        raise InvalidModel(f"The network's {layer} does not run over the channels.")
    channels, groups = part.get("channels", 0), part.get("groups", 1)
    if channels > MAX_CHANNELS or not 0 < groups <= MAX_CHANNELS or channels % groups:
        raise InvalidModel(f"The network's {layer} has {channels} channels in {groups} groups.")
    return Convolution(
        name=layer.name,
        channels=channels,
        kernel=_side(layer, part, "kernel"),
        stride=_side(layer, part, "stride", 1),
        pad=_side(layer, part, "pad", 0),
        groups=groups,
    )


def _translate_pooling(layer: CaffeLayer) -> Pooling:
    part = layer.part("pooling")
    method, rounding = part.get("method", 0), part.get("rounding", 0)
    if method not in (0, 1) or rounding not in (0, 1):
        raise InvalidModel(f"The network's {layer} pools in a way that cannot be imported.")
    pooling = Pooling(
        name=layer.name,
        method="average" if method else "max",
        kernel=_side(layer, part, "kernel"),
        stride=_side(layer, part, "stride", 1),
        pad=_side(layer, part, "pad", 0),
        ceil=not rounding,
    )
    if pooling.stride > pooling.kernel or 2 * pooling.pad > pooling.kernel:
        raise InvalidModel(f"The network's {layer} has windows that see nothing of the map.")
    return pooling


def _translate_normalization(layer: CaffeLayer) -> Normalization:
    part = layer.part("normalization")
    if part.get("within", 0):
        raise InvalidModel(f"The network's {layer} normalizes within a channel, not across channels.")
    size = part.get("size", 5)
    if size % 2 == 0 or size > MAX_CHANNELS:
        raise InvalidModel(f"The network's {layer} normalizes over {size} channels; an odd number is needed.")
    alpha, beta, k = (_finite(layer, part.get(*default)) for default in (("alpha", 1.0), ("beta", 0.75), ("k", 1.0)))
    return Normalization(name=layer.name, size=size, alpha=alpha, beta=beta, k=k)


def _finite(layer: CaffeLayer, value: float) -> float:
    if not math.isfinite(value):
        raise InvalidModel(f"The network's {layer} has a parameter that is not finite.")
    return value


def _side(layer: CaffeLayer, part: Part, what: str, default: int | None = None) -> int:
    """A length in pixels, the same for height and width, given once, for each axis, or as ``_h`` and ``_w``."""
    found = part.get(what, [])
    found = [*found] if isinstance(found, list) else [found]
    axes = (f"{what}_h", f"{what}_w")
    if any(axis in part for axis in axes):
        found += [part.get(axis, 0) for axis in axes]
    if not found and default is not None:
        return default
    if len(set(found)) != 1 or found[0] > MAX_SIDE:
        raise InvalidModel(f"The network's {layer} has the {what} {found}; one for both axes is needed.")
    side: int = found[0]
    return side


def _check_sizes(definition: NetworkDefinition) -> None:
    """Refuse a network whose maps shrink to nothing."""
    for axis in ("height", "width"):
        size: int = getattr(definition.input, axis)
        for layer in definition.layers:
            if not isinstance(layer, Convolution | Pooling):
                continue
            room = size + 2 * layer.pad - layer.kernel
            if room < 0:
                raise InvalidModel(f"The layer {layer.name!r} is larger than the map that it sees.")
            steps = room // layer.stride
            if isinstance(layer, Pooling) and layer.ceil and room % layer.stride:
                # One window more, unless it would begin in the border behind the map.
                steps += (steps + 1) * layer.stride < size + layer.pad
            size = steps + 1


# Weights


def _read_weights(definition: NetworkDefinition, trunk: Sequence[CaffeLayer]) -> dict[str, Tensor]:
    weights: dict[str, Tensor] = {}
    channels = 3
    for layer, source in zip(definition.layers, trunk, strict=True):
        if not isinstance(layer, Convolution):
            continue
        biased = source.part("convolution").get("bias", True)
        arrays = source.arrays()
        if len(arrays) != 1 + biased:
            raise InvalidModel(f"The network's {source} has {len(arrays)} arrays of weights, not {1 + biased}.")
        weight, bias = arrays if biased else (arrays[0], np.zeros(layer.channels, np.float32))
        wanted = (layer.channels, channels // layer.groups, layer.kernel, layer.kernel)
        if weight.shape != wanted or channels % layer.groups or bias.size != layer.channels:
            raise InvalidModel(
                f"The network's {source} has weights of the shape {weight.shape} and {bias.size} biases; "
                f"{wanted} and {layer.channels} are needed."
            )
        weights[f"{layer.name}.weight"] = torch.from_numpy(weight)
        weights[f"{layer.name}.bias"] = torch.from_numpy(bias.reshape(-1))
        channels = layer.channels
    return weights
