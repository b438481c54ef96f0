"""Small systems whose scores can be worked out by hand: a frame's value says what it is described by."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels
from lab.baselines.system import About, Description, InnerProducts, ReferenceIndex, stack


def write_images(folder: Path, values: Sequence[int]) -> list[Path]:
    """Files whose only content is their number: ``load`` makes a frame of it."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for place, value in enumerate(values):
        path = folder / f"{place}.png"
        path.write_text(str(value))
        paths.append(path)
    return paths


def load(path: Path) -> Pixels:
    """A 1 x 1 frame of the number in a file."""
    return np.full((1, 1, 3), int(path.read_text()), np.uint8)


class Lookup:
    """Describes a frame by the row of a table; half the inner product is the score.

    described: how many frames it has seen.
    """

    sequential = False

    def __init__(
        self, table: NDArray[np.float32], name: str = "lookup", stages: tuple[str, ...] = ("forward",)
    ) -> None:
        self.table, self.stages = table, stages
        self.about = About(name, name.capitalize(), "none", {"rows": len(table)})
        self.described = 0

    @property
    def identity(self) -> str:
        return f"{self.about.name}@0"

    def describe(self, pixels: Pixels) -> Description:
        self.described += 1
        row = self.table[int(pixels[0, 0, 0])]
        return Description({"descriptor": row, "extra": np.zeros(2, np.uint8)}, dict.fromkeys(self.stages, 2.0))

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return InnerProducts(stack(references), finish=lambda products: products / np.float32(2))


class Learner(Lookup):
    """Must see frames first; then it takes the mean of what they are described by away."""

    def __init__(self, table: NDArray[np.float32], name: str = "learner") -> None:
        super().__init__(table, name)
        self.mean: NDArray[np.float32] | None = None
        self.seen: list[int] = []

    @property
    def identity(self) -> str:
        return f"{self.about.name}@{'untrained' if self.mean is None else self.mean.tolist()}"

    def train(self, frames: Iterable[Pixels], seed: int) -> None:
        self.seen = [int(pixels[0, 0, 0]) for pixels in frames]
        self.mean = self.table[self.seen].mean(axis=0) * np.float32(seed + 1)

    def describe(self, pixels: Pixels) -> Description:
        assert self.mean is not None, "described before it was trained"
        self.described += 1
        return Description({"descriptor": self.table[int(pixels[0, 0, 0])] - self.mean})


class Together(Lookup):
    """Scores depend on all queries of a call: each row is less their mean."""

    sequential = True

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return _Together(stack(references))


class _Together:
    def __init__(self, known: NDArray[np.float32]) -> None:
        self.known = known
        self.calls: list[int] = []

    def score(self, queries: Sequence[Description]) -> NDArray[np.float32]:
        products = np.stack([query.arrays["descriptor"] for query in queries]) @ self.known.T
        return np.asarray(products - products.mean(axis=0), np.float32)
