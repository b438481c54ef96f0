"""What systems on a network's activations share: reading the maps, and one pooled vector a frame.

Maps are float32 [X, Y, K] of one frame, rectified, as ``FeatureExtractor.activations`` gives them;
those of a blank frame are zero.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from core.baselines.entry import Entry, Ingredients, system_identity
from core.baselines.system import About, Description, Index, InnerProducts, stack
from core.frames.preprocessing import Pixels

if TYPE_CHECKING:
    from core.method.features import FeatureExtractor

Array = NDArray[np.float32]
Pool = Callable[..., Array]
"""Maps of one or more layers to float32 [D], of any length."""


def read_maps(extractor: FeatureExtractor, pixels: Pixels) -> tuple[list[Array], float]:
    """The maps of each layer of one frame, and the milliseconds of the forward pass."""
    began = time.perf_counter()
    maps = extractor.activations([pixels])[0]
    return maps, 1e3 * (time.perf_counter() - began)


def unit(vectors: Array) -> Array:
    """Vectors along the last axis, each divided by its length; zero stays zero."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


class MapsSystem:
    """What such systems share: identity, and a description made of the maps alone, with its times.

    Args:
        extractor: gives the maps of the layers that :meth:`keep` gets.
    """

    sequential = False

    def __init__(self, about: About, extractor: FeatureExtractor) -> None:
        self.about, self.extractor = about, extractor
        self.identity = system_identity(about, features=extractor.origin)

    def describe(self, pixels: Pixels) -> Description:
        maps, forward = read_maps(self.extractor, pixels)
        began = time.perf_counter()
        arrays = self.keep(maps)
        return Description(arrays, {"forward": forward, "pool": 1e3 * (time.perf_counter() - began)})

    def keep(self, maps: list[Array]) -> dict[str, Array]:
        """What is kept of a frame, by name, from the maps of each layer."""
        raise NotImplementedError


class PooledSystem(MapsSystem):
    """Maps pooled to one vector of unit length; scores are cosines."""

    def __init__(self, about: About, extractor: FeatureExtractor, pool: Pool) -> None:
        super().__init__(about, extractor)
        self.pool = pool

    def keep(self, maps: list[Array]) -> dict[str, Array]:
        return {"descriptor": unit(self.pool(*maps))}

    def index(self, references: Sequence[Description]) -> Index:
        return InnerProducts(stack(references))


def pooled(about: About, pool: Pool, *layers: str) -> Entry:
    """The entry of a system that pools ``layers`` of the packaged network."""

    def build(ingredients: Ingredients) -> PooledSystem:
        return PooledSystem(about, ingredients.extractor(*layers), pool)

    return Entry(about, build)
