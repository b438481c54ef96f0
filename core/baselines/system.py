"""What every system that is compared looks like: a frame becomes a description, descriptions are compared.

A new system is one class with ``about``, ``identity``, ``describe`` and ``index``, and one line in
``catalogue.py``.  A system that learns something from pictures of its own (words, a tree) has ``train`` too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels


@dataclass(frozen=True)
class About:
    """What ``placerec evaluate --list`` says of a system.

    name: as it is asked for, such as ``seqslam``.
    paper: authors, title, venue and year.
    configuration: its constants, by their names in the paper.
    weights: one sentence naming the file that the user must supply; None where none is needed.
    """

    name: str
    title: str
    paper: str
    configuration: Mapping[str, str | int | float | bool | tuple[int | float | str, ...]]
    weights: str | None = None


@dataclass(frozen=True)
class Description:
    """What is kept of one frame.

    arrays: by name; all systems but the exact shapes are free.  Their bytes are the memory of a place.
    milliseconds: of the stages that made it, such as ``forward``, ``regions``, ``vlad``.
    """

    arrays: Mapping[str, NDArray[np.generic]]
    milliseconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        """Bytes that a place takes."""
        return sum(array.nbytes for array in self.arrays.values())


class Index(Protocol):
    """References ready to be compared with."""

    def compare(self, queries: Sequence[Description]) -> NDArray[np.float32]:
        """Scores, float32 [Q, R], higher is more alike, all finite; a sequential system takes the queries in order."""


class System(Protocol):
    """One way to recognize places.

    identity: name and a digest of all that can change a score: constants, weights, training.
    sequential: a score depends on the queries before it, so they must be compared all together.
    """

    @property
    def about(self) -> About: ...

    @property
    def identity(self) -> str: ...

    @property
    def sequential(self) -> bool: ...

    def describe(self, pixels: Pixels) -> Description:
        """Describe one frame, H x W x 3 uint8 BGR of any size; a blank frame gives a valid description too."""

    def index(self, references: Sequence[Description]) -> Index:
        """Make R >= 1 references ready; a sequential system takes them in order of their traverse."""


@runtime_checkable
class Trainable(Protocol):
    """A system that must see pictures of other places before it can describe or compare."""

    def train(self, pictures: Iterable[Pixels], seed: int) -> None:
        """Learn from the pictures; ``identity`` then speaks of what was learned."""


@dataclass(frozen=True)
class InnerProducts:
    """The index of a system whose description is one vector: scores are inner products.

    vectors: float32 [R, D].
    """

    vectors: NDArray[np.float32]
    name: str = "descriptor"
    finish: Callable[[NDArray[np.float32]], NDArray[np.float32]] | None = None
    """What turns inner products into the scores that users see; must not change their order."""

    def compare(self, queries: Sequence[Description]) -> NDArray[np.float32]:
        asked = np.stack([query.arrays[self.name] for query in queries])  # Q x D
        products = np.asarray(asked @ self.vectors.T, np.float32)  # Q x R
        return products if self.finish is None else self.finish(products)


def stack(descriptions: Sequence[Description], name: str = "descriptor") -> NDArray[np.float32]:
    """The arrays ``name`` of R descriptions as float32 [R, ...]."""
    return np.stack([description.arrays[name] for description in descriptions]).astype(np.float32, copy=False)
