"""The shape that all compared systems share: a frame becomes a description, and descriptions are scored.

A new system is one class with ``about``, ``identity``, ``describe`` and ``index``, and one row in
``lab.baselines.registry``.  A system that learns something from frames (words, a tree) has ``train`` too.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel
from core.frames.preprocessing import Pixels

if TYPE_CHECKING:
    from core.method.catalogue import EncoderCatalogue
    from core.method.features import FeatureExtractor

Array = NDArray[np.float32]
Constants = Mapping[str, str | int | float | bool | tuple[int | float | str, ...]]
"""A system's constants by their names in its paper."""


@dataclass(frozen=True)
class About:
    """The description of a system, as ``placerec evaluate --list`` shows it.

    name: the name that selects it on the command line, such as ``seqslam``.
    paper: authors, title, venue and year.
    configuration: its constants, by their names in the paper.
    weights: one sentence that names the file which the user must supply; None where none is needed.
    """

    name: str
    title: str
    paper: str
    configuration: Constants
    weights: str | None = None


@dataclass(frozen=True)
class Description:
    """A system's description of one frame.

    arrays: by name; a system is free to choose them.  Their bytes are the memory of a place.
    milliseconds: of the stages that made it, such as ``forward``, ``regions``, ``vlad``.
    """

    arrays: Mapping[str, NDArray[np.generic]]
    milliseconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        """Bytes that a place takes."""
        return sum(array.nbytes for array in self.arrays.values())


class ReferenceIndex(Protocol):
    """References that queries can be scored against."""

    def score(self, queries: Sequence[Description]) -> Array:
        """Scores, float32 [Q, R], all finite; higher is more alike.  A sequential system takes queries in order."""


class System(Protocol):
    """One way to recognize places.

    identity: name and a digest of all that can change a score: constants, weights, training.
    sequential: a score depends on the queries before it, so that all queries must be scored together.
    """

    @property
    def about(self) -> About: ...

    @property
    def identity(self) -> str: ...

    @property
    def sequential(self) -> bool: ...

    def describe(self, pixels: Pixels) -> Description:
        """Describe one frame, H x W x 3 uint8 BGR of any size; a blank frame gives a valid description too."""

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        """Prepare R >= 1 references; a sequential system takes them in the order of their traverse."""


@runtime_checkable
class Trainable(Protocol):
    """A system that must see frames of other places before it can describe or score."""

    def train(self, frames: Iterable[Pixels], seed: int) -> None:
        """Learn from the frames; afterwards ``identity`` covers what was learned."""


@dataclass(frozen=True)
class InnerProducts:
    """The index of a system whose description is one vector: scores are inner products.

    vectors: float32 [R, D].
    """

    vectors: Array
    name: str = "descriptor"
    finish: Callable[[Array], Array] | None = None
    """Turns inner products into the scores that users see; it must not change their order."""

    def score(self, queries: Sequence[Description]) -> Array:
        queried = np.stack([query.arrays[self.name] for query in queries])  # Q x D
        products = np.asarray(queried @ self.vectors.T, np.float32)  # Q x R
        return products if self.finish is None else self.finish(products)


class VectorSystem(ABC):
    """The base of systems that describe a frame by one vector of unit length and score by the cosine.

    Args:
        digests: by name, digests of all besides the constants that can change a score, such as the weights.
    """

    sequential = False

    def __init__(self, about: About, **digests: str) -> None:
        self.about, self.identity = about, system_identity(about, **digests)

    @abstractmethod
    def vector(self, pixels: Pixels) -> Array:
        """The vector of a frame, float32 [D], of unit length or zero."""

    def describe(self, pixels: Pixels) -> Description:
        began = time.perf_counter()
        vector = self.vector(pixels)
        return Description({"descriptor": vector}, {"forward": 1e3 * (time.perf_counter() - began)})

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return InnerProducts(stack(references))


@dataclass(frozen=True)
class Resources:
    """The inputs from which systems are built.

    models: the installed encoders and networks.
    weights: the file that the user gave for this system.  Where ``About.weights`` asks for a file, the registry
        has checked that it exists.
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
        # Only the maps are read, so what the definition says of regions is never used.
        definition = FeatureDefinition(layers=layers, regions=1, steps=tuple(1.0 for _ in layers), unit_features=False)
        return FeatureExtractor(load_network(network, layers), definition)

    def refuse_weights(self, about: About) -> None:
        """Refuse a file given to a system that could not use one.

        Raises:
            InvalidModel: there is one.
        """
        if self.weights is not None:
            raise InvalidModel(f"{about.name} uses no network, so it takes no file of weights.")

    def file(self) -> Path:
        """The weights file of a system whose ``About.weights`` asks for one."""
        assert self.weights is not None, "the registry checks this before it builds"
        return self.weights


def stack(descriptions: Sequence[Description], name: str = "descriptor") -> Array:
    """The arrays ``name`` of R descriptions as float32 [R, ...]."""
    return np.stack([description.arrays[name] for description in descriptions]).astype(np.float32, copy=False)


def unit(vectors: Array) -> Array:
    """Vectors along the last axis, each divided by its length; zero stays zero."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


def system_identity(about: About, **digests: str) -> str:
    """``<name>@<sha256>`` over the constants of a system and over ``digests``.

    Args:
        digests: by name, digests of all else that can change a score: weights, training.
    """
    from core.networks.identity import json_digest

    return f"{about.name}@{json_digest({'configuration': dict(about.configuration), **digests})}"


def arrays_digest(**arrays: NDArray[np.generic]) -> str:
    """SHA-256 over names, types, shapes and values: the learned state of a system, for its identity."""
    from core.networks import identity

    return identity.arrays_digest({name: np.ascontiguousarray(array) for name, array in arrays.items()})
