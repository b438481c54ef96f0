"""Queries of a map by the frames of its own places, from what it stores of them: nothing is encoded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from core.method.agreement import Cells
from core.method.encoder import Encoder
from core.places import Neighborhood
from core.storage import Map
from core.storage.transfer import Outline

Positions = NDArray[np.int64]

TOGETHER = 16
"""Queries of one search."""

HEAD = 400
"""So much of a ranking is looked at."""

_GOLDEN = (5**0.5 - 1) / 2


def spread(count: int) -> Positions:
    """0 … count - 1 in an order of which every beginning is spread evenly over them."""
    return np.argsort((np.arange(count) * _GOLDEN) % 1.0, kind="stable").astype(np.int64)


class SelfQueries:
    """The places of a map at one moment; positions count them in the order of their rows."""

    def __init__(self, map_: Map, encoder: Encoder) -> None:
        record = map_.record
        self.encoder, self.neighborhood = encoder, Neighborhood(record.same_place_radius, record.same_place_frames)
        outline = map_.transfer.outline()
        self.snapshot = map_.snapshot()
        # One that is being written in this very moment is listed before its row is in a snapshot.
        there = (place for place in outline if place.row < self.snapshot.rows)
        self.places: list[Outline] = sorted(there, key=lambda place: place.row)
        self.rows = np.array([place.row for place in self.places], np.int64)
        self.where = self.snapshot.whereabouts_at(self.rows)
        self._position = np.full(self.snapshot.rows, -1, np.int64)
        self._position[self.rows] = np.arange(len(self.rows))

    def __len__(self) -> int:
        return len(self.places)

    def near(self, position: int, others: Positions) -> NDArray[np.bool_]:
        """Which of ``others`` are the same place as one; bool [n]."""
        return self.where.take(np.concatenate([[position], others])).near(0, self.neighborhood)[1:]

    def local(self, positions: Positions) -> Cells:
        """The local descriptors of places, int8 [k, C, L]."""
        return self.snapshot.locals_at(self.rows[positions])

    def alike(self, pairs: Positions) -> NDArray[np.float32]:
        """Scores by the first stage of pairs of places, int64 [m, 2] to float32 [m]."""
        wanted, inverse = np.unique(pairs, return_inverse=True)
        inverse = inverse.reshape(pairs.shape)
        descriptors = self.snapshot.descriptors_at(self.rows[wanted])
        products = np.einsum("md,md->m", descriptors[inverse[:, 0]], descriptors[inverse[:, 1]])
        return np.asarray(self.encoder.scores_from_inner_products(products), np.float32)

    def search(
        self, positions: Sequence[int], references: NDArray[np.bool_] | None = None
    ) -> Iterator[tuple[int, Positions, NDArray[np.float32]]]:
        """Hold some places' frames, sixteen at most, against the map.

        Args:
            references: bool [places], those that are searched; None: all.

        Yields:
            Each position, with those of the best others, best first, and their scores by the first stage.
        """
        allowed = None
        if references is not None:
            allowed = np.zeros(self.snapshot.rows, np.bool_)
            allowed[self.rows[references]] = True
        chosen = np.asarray(positions, np.int64)
        descriptors = self.snapshot.descriptors_at(self.rows[chosen])
        for position, (rows, products) in zip(positions, self.snapshot.search_batch(descriptors, allowed), strict=True):
            found = self._position[rows[: HEAD + 1]]
            others = (found >= 0) & (found != position)
            scores = self.encoder.scores_from_inner_products(products[: HEAD + 1])
            yield position, found[others], scores[others]
