"""The interface that an encoder needs of a network."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import InputDefinition

Array = NDArray[np.float32]

Pass = Callable[[Array], tuple[Array, ...]]
"""A forward pass: float32 [B, H, W, 3] to one float32 [B, X, Y, K] for each output, contiguous.  Thread-safe."""

Precision = Literal["float32", "bfloat16", "float16"]
Device = Literal["cpu", "cuda"]


class Backbone(Protocol):
    """A network that gives an encoder the rectified activations of some of its layers; ``forward.py`` computes them."""

    @property
    def input(self) -> InputDefinition:
        """The input that the network expects."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """The names of the layers whose activations a pass returns, in that order."""

    def describe(self) -> dict[str, Any]:
        """Everything besides the weights that can change an activation, as values for JSON."""

    def weights(self) -> Mapping[str, NDArray[Any]]:
        """The arrays in use, by name."""


class OwnPass(Backbone, Protocol):
    """A backbone that computes its forward pass in its own way."""

    def __call__(self, images: Array) -> tuple[Array, ...]:
        """float32 [B, H, W, 3] to one float32 [B, X, Y, K] for each output."""
