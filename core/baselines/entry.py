"""A line of the catalogue: what a system is, and how it is made of what the user has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from core.baselines.system import About, System
from core.errors import InvalidModel

if TYPE_CHECKING:
    from core.method.catalogue import EncoderCatalogue
    from core.method.features import FeatureExtractor

Constants = Mapping[str, str | int | float | bool | tuple[int | float | str, ...]]
"""A system's constants by their names in its paper, as ``About.configuration`` wants them."""


@dataclass(frozen=True)
class Ingredients:
    """What a system may be made of.

    models: the installed encoders and networks.
    weights: the file that the user gave for this system; the catalogue has seen that it is there
        where ``About.weights`` asks for one.
    """

    models: EncoderCatalogue
    weights: Path | None = None

    def extractor(self, *layers: str) -> FeatureExtractor:
        """Frames to the rectified maps of ``layers``, in that order, by the network of the default encoder.

        A weights file takes its place: a network file such as ``placerec model import`` writes.

        Raises:
            InvalidModel: the network has no such layer, or its file cannot be used.
        """
        from core.method.features import FeatureDefinition, FeatureExtractor
        from core.networks.network import load_network

        network = self.weights
        if network is None:
            network = self.models.network_file(next(s.network for s in self.models.describe() if s.default))
        # Only the maps are read: what is said of regions here is never used.
        definition = FeatureDefinition(layers=layers, regions=1, steps=tuple(1.0 for _ in layers), unit_features=False)
        return FeatureExtractor(load_network(network, layers), definition)

    def none(self, about: About) -> None:
        """Refuse a file given to a system that could not use one.

        Raises:
            InvalidModel: there is one.
        """
        if self.weights is not None:
            raise InvalidModel(f"{about.name} uses no network, so it takes no file of weights.")

    def file(self) -> Path:
        """The weights file of a system whose ``About.weights`` asks for one."""
        assert self.weights is not None, "the catalogue checks this before it builds"
        return self.weights


@dataclass(frozen=True)
class Entry:
    """One system of the catalogue; each module of systems has a tuple ``SYSTEMS`` of them.

    about: known without reading a weight.
    build: called once per evaluation; reads the weights.
    """

    about: About
    build: Callable[[Ingredients], System]


def system_identity(about: About, **parts: str) -> str:
    """``<name>@<sha256>`` over the constants of a system and over ``parts``.

    Args:
        parts: by name, digests of all else that can change a score: weights, training.
    """
    from core.networks.identity import json_digest

    return f"{about.name}@{json_digest({'configuration': dict(about.configuration), **parts})}"


def arrays_digest(**arrays: NDArray[np.generic]) -> str:
    """SHA-256 over names, types, shapes and values: what a system has learned, for its identity."""
    import torch

    from core.networks.identity import tensors_digest

    return tensors_digest({name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()})
