"""The comparison of a query with places of a ranking by its third stage, dearer with each of its three methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from core.errors import UnknownPlace
from core.geometry.keypoints import Keypoints
from core.geometry.matching import count_matches
from core.geometry.verification import LEAST_MATCHES, Verification, verify
from core.method.agreement import Cells
from core.method.encoder import Encoder
from core.recognition.question import Verifier
from core.store import Map


class Comparison(Protocol):
    """Compares one query with places, which are named by their rows."""

    def matches_at_a_glance(self, rows: Sequence[int]) -> NDArray[np.int64]:
        """How many of the best keypoints match, int64 [n]; 0 for a place without keypoints."""

    def agreements(self, rows: Sequence[int]) -> NDArray[np.float32]:
        """The gains of the second stage, float32 [n]."""

    def verifications(self, rows: Sequence[int]) -> list[Verification | None]:
        """The geometric evidence; None for a place without keypoints, and of a query that has hardly any."""


@dataclass(frozen=True)
class MapComparison:
    """The comparison of a query with places of a map; the query's keypoints are found when a place has any.

    local: the query's local descriptors, int8 [C, L].
    verifier: has the keypoints of the query.
    stored: of the places that were verified, by their rows.
    """

    map_: Map
    encoder: Encoder
    local: Cells
    verifier: Verifier
    stored: dict[int, Keypoints] = field(default_factory=dict)

    def matches_at_a_glance(self, rows: Sequence[int]) -> NDArray[np.int64]:
        glances = self.map_.glances_at(rows)
        return count_matches(self.verifier.keypoints, glances) if glances.any() else np.zeros(len(rows), np.int64)

    def agreements(self, rows: Sequence[int]) -> NDArray[np.float32]:
        try:
            cells = self.map_.snapshot().locals_at(np.array(rows, np.int64))
        except UnknownPlace:  # one was deleted since the search
            return np.zeros(len(rows), np.float32)
        return self.encoder.agreement(self.local, cells)

    def verifications(self, rows: Sequence[int]) -> list[Verification | None]:
        kept = {row: one for row, one in zip(rows, self.map_.keypoints_at(rows), strict=True) if one is not None}
        if not kept or len(self.verifier.keypoints) < LEAST_MATCHES:
            return [None] * len(rows)
        self.stored.update(kept)
        found = dict(zip(kept, verify(self.verifier.keypoints, list(kept.values())), strict=True))
        return [found.get(row) for row in rows]
