"""The shallow CaffeNet-family backbone as data: its layers, its weights, its file.

A network is described by data (:class:`NetworkDefinition`), so that HybridNet, AMOSNet, CaffeNet, AlexNet365 and the
packaged distilled network are five descriptions of one thing.  Only the weights up to the deepest layer in use are
loaded (thesis, section 4.3).  ``forward.py`` computes it, and ``torch_network.py`` where torch is needed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition
from core.names import file_names
from core.networks.backbone import Array

FORMAT = "placerec-network/1"
NAMES = file_names("a network")


class _Layer(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str


class Convolution(_Layer):
    """A grouped 2-D convolution with a bias."""

    type: Literal["convolution"] = "convolution"
    channels: int = Field(gt=0)
    kernel: int = Field(gt=0)
    stride: int = Field(default=1, gt=0)
    pad: int = Field(default=0, ge=0)
    groups: int = Field(default=1, gt=0)


class Relu(_Layer):
    """max(x, slope·x).  Caffe runs it in place: the layer before it is seen rectified."""

    type: Literal["relu"] = "relu"
    negative_slope: float = 0.0


class Pooling(_Layer):
    """Spatial pooling; Caffe rounds the output size up (``ceil``), torch's default rounds down."""

    type: Literal["pooling"] = "pooling"
    method: Literal["max", "average"] = "max"
    kernel: int = Field(gt=0)
    stride: int = Field(gt=0)
    pad: int = Field(default=0, ge=0)
    ceil: bool = True


class Normalization(_Layer):
    """Local response normalization across channels (Krizhevsky et al., 2012, section 3.3)."""

    type: Literal["normalization"] = "normalization"
    size: int = Field(default=5, gt=0)
    alpha: float = 1e-4
    beta: float = 0.75
    k: float = 1.0


Layer = Convolution | Relu | Pooling | Normalization


class NetworkDefinition(BaseModel):
    """Everything that turns colour pixels into activations, apart from the weights."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, NAMES]
    input: InputDefinition
    layers: tuple[Annotated[Layer, Field(discriminator="type")], ...]

    @model_validator(mode="after")
    def _names_are_unique(self) -> NetworkDefinition:
        names = [layer.name for layer in self.layers]
        if len(set(names)) != len(names):
            raise ValueError("layer names are not unique")
        if not any(isinstance(layer, Convolution) for layer in self.layers):
            raise ValueError("a network needs at least one convolution")
        return self

    def convolutions(self) -> tuple[Convolution, ...]:
        """The convolutions, shallowest first."""
        return tuple(layer for layer in self.layers if isinstance(layer, Convolution))

    def truncated(self, names: Iterable[str]) -> NetworkDefinition:
        """This network, cut off after the deepest of the convolutions (and its rectifier) or poolings ``names``.

        Raises:
            InvalidModel: a name is not that of a convolution or pooling of this network.
        """
        wanted = set(names)
        offered = [layer.name for layer in self.layers if isinstance(layer, Convolution | Pooling)]
        missing = wanted - set(offered)
        if missing or not wanted:
            raise InvalidModel(
                f"network {self.name!r} has no convolution or pooling named "
                f"{', '.join(sorted(missing)) or '(none given)'}; it has {', '.join(offered)}"
            )
        last = max(i for i, layer in enumerate(self.layers) if layer.name in wanted)
        if last + 1 < len(self.layers) and isinstance(self.layers[last + 1], Relu):
            last += 1
        return self.model_copy(update={"layers": self.layers[: last + 1]})

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes of ``<layer>.weight``, [K, K before / groups, side, side], and ``<layer>.bias``, [K].

        Raises:
            InvalidModel: a convolution's channels, or those before it, are not shared out evenly among its groups.
        """
        shapes: dict[str, tuple[int, ...]] = {}
        before = 3
        for layer in self.convolutions():
            if before % layer.groups or layer.channels % layer.groups:
                raise InvalidModel(
                    f"layer {layer.name} of {self.name!r} cannot be built: {before} and {layer.channels} channels "
                    f"do not divide into {layer.groups} groups"
                )
            shapes[f"{layer.name}.weight"] = layer.channels, before // layer.groups, layer.kernel, layer.kernel
            shapes[f"{layer.name}.bias"] = (layer.channels,)
            before = layer.channels
        return shapes


def caffenet_definition(
    name: str,
    *,
    normalize: bool = True,
    norm_before_pool: bool = False,
    depth: int = 5,
    scale: float = 1.0,
) -> NetworkDefinition:
    """The CaffeNet layout (Jia et al., 2014): conv1 96 · conv2 256 · conv3 384 · conv4 384 · conv5 256.

    Args:
        normalize: with the two local response normalizations (the packaged network has none).
        norm_before_pool: AlexNet's order instead of CaffeNet's.
        depth: how many of the five convolutions to use.
        scale: factor on the mean-subtracted 0–255 pixels.
    """
    convolutions = (
        Convolution(name="conv1", channels=96, kernel=11, stride=4),
        Convolution(name="conv2", channels=256, kernel=5, pad=2, groups=2),
        Convolution(name="conv3", channels=384, kernel=3, pad=1),
        Convolution(name="conv4", channels=384, kernel=3, pad=1, groups=2),
        Convolution(name="conv5", channels=256, kernel=3, pad=1, groups=2),
    )
    layers: list[Layer] = []
    for number, convolution in enumerate(convolutions[:depth], start=1):
        layers += [convolution, Relu(name=f"relu{number}")]
        if number <= 2:
            shrink: list[Layer] = [Pooling(name=f"pool{number}", kernel=3, stride=2)]
            if normalize:
                shrink.insert(0 if norm_before_pool else 1, Normalization(name=f"norm{number}"))
            layers += shrink
    shown = InputDefinition(height=227, width=227, mean=(104.0, 117.0, 123.0), scale=(scale,) * 3)
    return NetworkDefinition(name=name, input=shown, layers=tuple(layers))


class ShallowNetwork:
    """A sequential network whose rectified convolutions and poolings can be read by name.

    Args:
        definition: the layers; those after the deepest output are left out.
        outputs: the convolutions and poolings to return, in this order.
        weights: ``<layer>.weight`` and ``<layer>.bias`` of each convolution in use; deeper ones are ignored.

    Raises:
        InvalidModel: an output is not a convolution or pooling of the definition; weights are missing, have another
            shape, or are not finite.
    """

    def __init__(self, definition: NetworkDefinition, outputs: Iterable[str], weights: Mapping[str, Array]) -> None:
        self.outputs = tuple(outputs)
        self.definition = definition.truncated(self.outputs)
        self._weights = {
            name: _checked(self.definition.name, name, shape, weights)
            for name, shape in self.definition.weight_shapes().items()
        }

    @property
    def input(self) -> InputDefinition:
        """The input that the network expects."""
        return self.definition.input

    def describe(self) -> dict[str, Any]:
        """Everything besides the weights that can change an activation, as values for JSON; not the name."""
        return self.definition.model_dump(mode="json", exclude={"name"}) | {"outputs": list(self.outputs)}

    def weights(self) -> dict[str, Array]:
        """``<layer>.weight`` and ``<layer>.bias`` of each convolution in use, float32."""
        return dict(self._weights)


def _checked(network: str, name: str, shape: tuple[int, ...], weights: Mapping[str, Array]) -> Array:
    """The weights of one name, float32."""
    if name not in weights:
        raise InvalidModel(f"the weights of {network!r} lack {name}")
    found = np.asarray(weights[name], np.float32, order="C")
    if found.shape != shape:
        raise InvalidModel(f"{name} has shape {found.shape}, the network needs {shape}")
    if not np.isfinite(found).all():
        raise InvalidModel(f"{name} holds values that are not finite")
    return found


def save_network(path: Path, definition: NetworkDefinition, weights: Mapping[str, Array]) -> None:
    """Write definition and weights to one safetensors file."""
    metadata = {"format": FORMAT, "definition": definition.model_dump_json()}
    save_file({name: np.ascontiguousarray(array) for name, array in weights.items()}, path, metadata)
    path.chmod(0o644)


def read_definition(path: Path) -> NetworkDefinition:
    """Read the definition in a network file, without the weights.

    Raises:
        InvalidModel: the file is missing, damaged or of another format.
    """
    try:
        with safe_open(path, "np") as file:
            metadata = file.metadata() or {}
        if metadata.get("format") != FORMAT:
            raise InvalidModel(f"{path.name} is not a {FORMAT} file.")
        return NetworkDefinition.model_validate_json(metadata["definition"])
    except (OSError, SafetensorError, KeyError, ValidationError) as error:
        raise InvalidModel(f"{path.name} is not a readable network file: {error}") from error


def load_network(path: Path, outputs: Iterable[str]) -> ShallowNetwork:
    """Load a network from its file, only as deep as the outputs need.

    Raises:
        InvalidModel: the file or an output name cannot be used.
    """
    outputs = tuple(outputs)
    definition = read_definition(path).truncated(outputs)
    try:
        with safe_open(path, "np") as file:
            wanted = definition.weight_shapes().keys() & set(file.keys())
            weights: dict[str, NDArray[Any]] = {name: file.get_tensor(name) for name in wanted}
    except (OSError, SafetensorError, TypeError) as error:  # the last of a type that NumPy lacks
        raise InvalidModel(f"{path.name} cannot be read: {error}") from error
    return ShallowNetwork(definition, outputs, weights)
