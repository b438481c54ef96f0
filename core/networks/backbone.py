"""The interface that an encoder needs of a network, and an adapter for any torch network."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition


class Backbone(Protocol):
    """A network that gives an encoder the rectified activations of some of its layers."""

    @property
    def input(self) -> InputDefinition:
        """The input that the network expects."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """The names of the layers whose activations a call returns, in that order."""

    def describe(self) -> dict[str, Any]:
        """Everything besides the weights that can change an activation, as values for JSON."""

    def weights(self) -> Mapping[str, Tensor]:
        """The tensors in use, by name."""

    def __call__(self, images: Tensor) -> tuple[Tensor, ...]:
        """Compute the activations: float32 [B, 3, H, W] to one float32 [B, K, X, Y] for each output."""


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

    def weights(self) -> Mapping[str, Tensor]:
        return self.module.state_dict()

    def __call__(self, images: Tensor) -> tuple[Tensor, ...]:
        found: list[Tensor | None] = [None] * len(self._layers)

        def keep(index: int) -> Any:
            def hook(_module: nn.Module, _inputs: Any, output: Tensor) -> None:
                # A copy: a rectifier that works in place may follow.
                found[index] = torch.relu(output) if self.rectify else output.clone()

            return hook

        handles = [layer.register_forward_hook(keep(i)) for i, layer in enumerate(self._layers)]
        try:
            self.module(images)
        finally:
            for handle in handles:
                handle.remove()
        missing = [name for name, value in zip(self.outputs, found, strict=True) if value is None]
        if missing:
            raise InvalidModel(f"{self.description} did not run its layer {', '.join(missing)}.")
        return tuple(value for value in found if value is not None)
