"""Geometric verification of the pairs of two traverses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.geometry import verification
from core.geometry.keypoints import Keypoints

Positions = NDArray[np.int64]
Values = NDArray[np.float64]


class Pairs:
    """The verification of pairs of Q queries and R references; each pair is verified when it is first needed.

    evidence: float64 [Q, R]; share: float64 [Q, R], inliers by the keypoints of the picture that has fewer.  NaN where
    a pair is not verified yet.
    """

    def __init__(
        self,
        queries: Sequence[Keypoints],
        references: Sequence[Keypoints],
        evidence: Values | None = None,
        share: Values | None = None,
    ) -> None:
        unknown = np.full((len(queries), len(references)), np.nan)
        self.queries, self.references = queries, references
        self.evidence = unknown.copy() if evidence is None else evidence
        self.share = unknown if share is None else share

    def verified(self, query: int, places: Positions) -> tuple[Values, Values]:
        """Evidence and share of some references, int64 [n], in their order; float64 [n] each."""
        missing = places[np.isnan(self.evidence[query, places])]
        candidates = [self.references[place] for place in missing.tolist()]
        found = verification.verify(self.queries[query], candidates) if candidates else []
        for place, one in zip(missing.tolist(), found, strict=True):
            self.evidence[query, place] = one.evidence
            self.share[query, place] = one.inlier_share
        return self.evidence[query, places], self.share[query, places]
