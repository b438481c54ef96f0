"""A system under evaluation: trained if it learns, and its descriptions, computed once for all measurements."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel
from core.frames.preprocessing import Pixels
from core.threads import keep_numpy_single_threaded
from lab.baselines.system import About, Description, ReferenceIndex, System, Trainable
from lab.evaluation.cache import arrays_digest, cache_key, files_digest
from lab.evaluation.data.pairs import TraversePair

Load = Callable[[Path], Pixels]
Change = Callable[[Pixels, int], Pixels]
"""Changes a frame before it is described, given its number in the traverse."""


@dataclass(frozen=True)
class Training:
    """The images that systems learn from.

    source: where they come from, in words.
    """

    images: list[Path]
    source: str
    seed: int = 0


@dataclass(frozen=True)
class Described:
    """The descriptions of a traverse, and what each took, milliseconds [n]."""

    descriptions: list[Description]
    milliseconds: list[float]


@dataclass(frozen=True)
class Scored:
    """Scores of queries against references, float32 [Q, R'], and what each query took, milliseconds [Q]."""

    scores: NDArray[np.float32]
    milliseconds: list[float]


class Subject:
    """One system on one pair of traverses.

    Nothing is computed before it is needed; training comes first where a system learns.

    Args:
        load: decodes an image; its exceptions end the run.
        advance: called after each image that is learned from or described, and after each query that is scored.
    """

    def __init__(
        self,
        system: System,
        pair: TraversePair,
        training: Training,
        load: Load,
        advance: Callable[[], None] = lambda: None,
    ) -> None:
        keep_numpy_single_threaded()  # as encoders do, so that the times of all systems compare
        self.system, self.pair, self.training = system, pair, training
        self._load, self._advance = load, advance
        self._trained = not isinstance(system, Trainable)
        self._learns = not self._trained
        self._untrained_identity = system.identity

    @property
    def trained_on(self) -> str | None:
        """The training data of the system, in words; None for a system that does not learn."""
        return self.training.source if self._learns else None

    @property
    def about(self) -> About:
        """The system's description; the configuration of one that learns names its training images."""
        about = self.system.about
        if not self._learns:
            return about
        return replace(about, configuration={**about.configuration, "trained on": self.training.source})

    @property
    def steps(self) -> int:
        """How often ``advance`` is called in a measurement: images learned from or described, and queries scored."""
        learned = len(self.training.images) if self._learns else 0
        return learned + len(self.pair.retained) + 2 * len(self.pair.queries)

    def key(self, kind: str, **parts: object) -> str:
        """The cache key of a measurement of this subject.

        Args:
            kind: of measurement.
            parts: JSON, its further dependencies.
        """
        training = [files_digest(self.training.images), self.training.seed] if self._learns else None
        return cache_key(
            kind=kind,
            system=self._untrained_identity,
            configuration=dict(self.system.about.configuration),
            training=training,
            references=files_digest(self.pair.retained_references),
            queries=files_digest(self.pair.queries),
            **parts,
        )

    @property
    def judged_by(self) -> dict[str, str]:
        """The inputs of a judgement, as parts of a cache key: the truth, and the references that are left out."""
        excluded = {} if self.pair.excluded is None else {"excluded": arrays_digest(self.pair.excluded)}
        return {"truth": arrays_digest(self.pair.truth), **excluded}

    @cached_property
    def references(self) -> Described:
        """The descriptions of the retained references."""
        return self.describe(self.pair.retained_references)

    @cached_property
    def queries(self) -> Described:
        """The descriptions of the undisturbed queries."""
        return self.describe(self.pair.queries)

    def frame(self, path: Path) -> Pixels:
        """One image of the traverses, decoded.

        Raises:
            Others: errors of decoding it.
        """
        return self._load(path)

    def describe(self, paths: Sequence[Path], change: Change | None = None) -> Described:
        """Describe images one after another; decoding them is not timed."""
        self._train()
        descriptions, times = [], []
        for number, path in enumerate(paths):
            pixels = self._load(path)
            if change is not None:
                pixels = change(pixels, number)
            began = time.perf_counter()
            descriptions.append(self.system.describe(pixels))
            times.append(1e3 * (time.perf_counter() - began))
            self._advance()
        return Described(descriptions, times)

    def score(self, index: ReferenceIndex, queries: Sequence[Description]) -> Scored:
        """Scores of the queries, each scored and timed alone unless the system is sequential.

        Raises:
            InvalidModel: the system gives scores that are not finite, or of another shape.
        """
        batches = [queries] if self.system.sequential else [[query] for query in queries]
        rows, times = [], []
        for batch in batches:
            began = time.perf_counter()
            rows.append(index.score(batch))
            times += [1e3 * (time.perf_counter() - began) / len(batch)] * len(batch)
            for _ in batch:
                self._advance()
        scores = np.concatenate(rows).astype(np.float32, copy=False)
        if scores.ndim != 2 or len(scores) != len(queries) or not np.isfinite(scores).all():
            raise InvalidModel(f"{self.system.about.name} gave scores of the shape {scores.shape}, or not finite ones.")
        return Scored(scores, times)

    def _train(self) -> None:
        if self._trained:
            return
        assert isinstance(self.system, Trainable)
        self.system.train(self._training_frames(), self.training.seed)
        self._trained = True

    def _training_frames(self) -> Iterator[Pixels]:
        for path in self.training.images:
            yield self._load(path)
            self._advance()
