"""Shallow networks as torch modules, to train them and to compute them where ONNX Runtime does not; any other module.

Whatever imports this module loads torch, which takes a second and 200 MB: the service does so only where torch
computes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition
from core.networks.backbone import Array
from core.networks.identity import arrays_digest
from core.networks.network import (
    Convolution,
    Layer,
    NetworkDefinition,
    Normalization,
    Pooling,
    Relu,
    ShallowNetwork,
    load_network,
)
from core.threads import allowed_threads


def as_tensor(images: Array) -> Tensor:
    """Images, [B, H, W, 3], as torch's modules take them: [B, 3, H, W], channels last in memory; not copied."""
    return torch.from_numpy(images).permute(0, 3, 1, 2)


def as_array(maps: Tensor) -> Array:
    """Maps of torch, [B, K, X, Y], as float32 [B, X, Y, K]."""
    return maps.detach().to("cpu", torch.float32).permute(0, 2, 3, 1).contiguous().numpy()


def arrays_of(tensors: Mapping[str, Tensor]) -> dict[str, Array]:
    """Tensors as arrays of their types, which share memory with tensors on the processor."""
    return {name: tensor.detach().cpu().contiguous().numpy() for name, tensor in tensors.items()}


def tensors_digest(tensors: Mapping[str, Tensor]) -> str:
    """The SHA-256 over the names and contents of tensors (``identity.arrays_digest``)."""
    return arrays_digest(arrays_of(tensors))


def follow_threads() -> None:
    """Let torch compute with as many threads as the calling thread may use (``core.threads``)."""
    if torch.get_num_threads() != allowed_threads():
        torch.set_num_threads(allowed_threads())


class LocalResponseNormalization(nn.Module):
    """x / (k + α/n · Σ x²)^β over n neighbouring channels, as both Caffe and torch compute it."""

    def __init__(self, layer: Normalization) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, x: Tensor) -> Tensor:
        layer = self.layer
        wide = x.float() if x.dtype == torch.bfloat16 else x  # which torch's pooling of channels lacks
        return nn.functional.local_response_norm(wide, layer.size, layer.alpha, layer.beta, layer.k).to(x.dtype)


def build_layer(layer: Layer, channels: int) -> nn.Module:
    """The torch module of one layer that receives ``channels`` input channels."""
    match layer:
        case Convolution():
            return nn.Conv2d(channels, layer.channels, layer.kernel, layer.stride, layer.pad, groups=layer.groups)
        case Relu(negative_slope=0.0):
            return nn.ReLU(inplace=True)
        case Relu():
            return nn.LeakyReLU(layer.negative_slope, inplace=True)
        case Pooling(method="max"):
            return nn.MaxPool2d(layer.kernel, layer.stride, layer.pad, ceil_mode=layer.ceil)
        case Pooling():
            return nn.AvgPool2d(layer.kernel, layer.stride, layer.pad, ceil_mode=layer.ceil)
        case Normalization():
            return LocalResponseNormalization(layer)


class TorchNetwork(nn.Module):
    """A sequential network whose rectified convolutions and poolings can be read by name.

    Args:
        definition: the layers; those after the deepest output are left out.
        outputs: the convolutions and poolings to return, in this order.

    Raises:
        InvalidModel: an output is not a convolution or pooling of the definition.
    """

    def __init__(self, definition: NetworkDefinition, outputs: Iterable[str]) -> None:
        super().__init__()
        self.outputs = tuple(outputs)
        self.definition = definition.truncated(self.outputs)
        self.stages = nn.ModuleDict()
        channels = 3
        try:
            for layer in self.definition.layers:
                self.stages[layer.name] = build_layer(layer, channels)
                channels = layer.channels if isinstance(layer, Convolution) else channels
        except (KeyError, ValueError) as error:
            raise InvalidModel(f"layer {layer.name} of {self.definition.name!r} cannot be built: {error}") from error

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:  # B x 3 x H x W
        """The activations of the outputs (convolutions after their rectifier, and poolings), each [B, K, X, Y]."""
        found: dict[str, Tensor] = {}
        x, open_name = images, ""
        for layer in self.definition.layers:
            if open_name and not isinstance(layer, Relu):
                found[open_name], open_name = x, ""
            x = self.stages[layer.name](x)
            if isinstance(layer, Convolution):
                open_name = layer.name
            elif isinstance(layer, Pooling) and layer.name in self.outputs:
                found[layer.name] = x
        if open_name:
            found[open_name] = x
        return tuple(found[name] for name in self.outputs)

    @classmethod
    def of(cls, network: ShallowNetwork) -> TorchNetwork:
        """A copy of a network, which is not to be trained, with its maps channels last in memory."""
        made = cls(network.definition, network.outputs)
        made.load_weights({name: torch.from_numpy(array) for name, array in network.weights().items()})
        return made.eval().requires_grad_(False).to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def as_data(self) -> ShallowNetwork:
        """A copy of the network as data."""
        return ShallowNetwork(self.definition, self.outputs, self.weights())

    @property
    def input(self) -> InputDefinition:
        """The input that the network expects."""
        return self.definition.input

    def describe(self) -> dict[str, Any]:
        """Everything besides the weights that can change an activation, as values for JSON; not the name."""
        return self.as_data().describe()

    def weights(self) -> dict[str, Array]:
        """The arrays ``<layer>.weight`` and ``<layer>.bias`` of each convolution in use."""
        return arrays_of(self.tensors())

    def tensors(self) -> dict[str, Tensor]:
        """The same as tensors, which share their memory with the network."""
        return {key.removeprefix("stages."): tensor for key, tensor in self.state_dict().items()}

    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        """Load ``<layer>.weight`` and ``<layer>.bias`` of each convolution in use; deeper ones are ignored.

        Raises:
            InvalidModel: a tensor is missing, has another shape, or is not finite.
        """
        checked = ShallowNetwork(self.definition, self.outputs, arrays_of(weights)).weights()
        with torch.no_grad():
            for name, array in checked.items():
                layer, _, kind = name.rpartition(".")
                getattr(self.stages[layer], kind).copy_(torch.from_numpy(array))


def load_torch_network(path: Path, outputs: Iterable[str]) -> TorchNetwork:
    """Load a network from its file as a module that is not to be trained, only as deep as the outputs need.

    Raises:
        InvalidModel: the file or an output name cannot be used.
    """
    return TorchNetwork.of(load_network(path, outputs))


class PluggedNetwork:
    """Makes any torch module a backbone.

    Args:
        module: is put into evaluation mode; it may compute more than the outputs need.
        outputs: names of submodules as in ``module.named_modules()``, each with an output [B, K, X, Y].
        shown: the input that the module expects.
        description: further properties that distinguish the network (its class, its version); part of the identity.
        rectify: clip the outputs at zero, for layers that come before their rectifier.

    Raises:
        InvalidModel: an output is not a submodule.
    """

    def __init__(
        self,
        module: nn.Module,
        outputs: Iterable[str],
        shown: InputDefinition,
        description: str,
        rectify: bool = True,
    ) -> None:
        self.module = module.eval().requires_grad_(False)
        self.input = shown
        self.outputs = tuple(outputs)
        self.description, self.rectify = description, rectify
        submodules = dict(module.named_modules())
        missing = [name for name in self.outputs if name not in submodules or not name]
        if missing or not self.outputs:
            raise InvalidModel(f"{description} has no layer named {', '.join(missing) or '(none given)'}.")
        self._layers = [submodules[name] for name in self.outputs]

    def describe(self) -> dict[str, Any]:
        return {
            "module": self.description,
            "outputs": self.outputs,
            "input": self.input.model_dump(mode="json"),
            "rectify": self.rectify,
        }

    def weights(self) -> Mapping[str, Array]:
        return arrays_of(self.module.state_dict())

    def __call__(self, images: Array) -> tuple[Array, ...]:
        """float32 [B, H, W, 3] to one float32 [B, X, Y, K] for each output.

        Raises:
            InvalidModel: the module did not run one of its layers.
        """
        follow_threads()
        found: list[Tensor | None] = [None] * len(self._layers)

        def keep(index: int) -> Any:
            def hook(_module: nn.Module, _inputs: Any, output: Tensor) -> None:
                # A copy: a rectifier that works in place may follow.
                found[index] = torch.relu(output) if self.rectify else output.clone()

            return hook

        handles = [layer.register_forward_hook(keep(i)) for i, layer in enumerate(self._layers)]
        try:
            with torch.inference_mode():
                self.module(as_tensor(images))
        finally:
            for handle in handles:
                handle.remove()
        missing = [name for name, value in zip(self.outputs, found, strict=True) if value is None]
        if missing:
            raise InvalidModel(f"{self.description} did not run its layer {', '.join(missing)}.")
        return tuple(as_array(value) for value in found if value is not None)
