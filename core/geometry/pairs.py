"""Geometric verification of the pairs of two traverses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from core.geometry import verification
from core.geometry.keypoints import LENGTH, Keypoints
from core.geometry.matching import GLANCED, count_matches, glance_at
from core.geometry.verification import Verification


@dataclass(frozen=True)
class Pairs:
    """The verification of pairs of Q queries and R references; each pair is verified when it is first needed.

    found: the results, by query and reference.
    """

    queries: Sequence[Keypoints]
    references: Sequence[Keypoints]
    found: dict[tuple[int, int], Verification] = field(default_factory=dict)

    @cached_property
    def glances(self) -> NDArray[np.int8]:
        """At the references, int8 [R, GLANCED, 64]."""
        return np.array([glance_at(one) for one in self.references], np.int8).reshape(-1, GLANCED, LENGTH)

    def verified(self, query: int, references: Sequence[int]) -> list[Verification]:
        """The results for some references, in their order."""
        missing = [reference for reference in references if (query, reference) not in self.found]
        results = verification.verify(self.queries[query], [self.references[one] for one in missing])
        self.found.update({(query, reference): one for reference, one in zip(missing, results, strict=True)})
        return [self.found[query, reference] for reference in references]

    def comparison(self, query: int, agreements: Callable[[Sequence[int]], NDArray[np.float32]]) -> PairComparison:
        """The comparison of one query with the references (``core.recognition.comparison``)."""
        return PairComparison(self, query, agreements)


@dataclass(frozen=True)
class PairComparison:
    """Compares one query with references, which are named by their numbers.

    agreements: returns the gains of the second stage, float32 [n].
    """

    pairs: Pairs
    query: int
    agreements: Callable[[Sequence[int]], NDArray[np.float32]]

    def matches_at_a_glance(self, rows: Sequence[int]) -> NDArray[np.int64]:
        return count_matches(self.pairs.queries[self.query], self.pairs.glances[list(rows)])

    def verifications(self, rows: Sequence[int]) -> list[Verification | None]:
        return [*self.pairs.verified(self.query, rows)]
