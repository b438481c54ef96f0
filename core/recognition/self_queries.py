"""Queries of a map by its own places, whose stored descriptors serve as queries: nothing is encoded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from core.maps import own_poses
from core.maps.records import Outline
from core.method.agreement import Cells
from core.method.encoder import Encoder
from core.recognition.stages import neighborhood_of
from core.store import Map

Positions = NDArray[np.int64]

TOGETHER = 16
"""The most queries of one search."""

HEAD = 400
"""How many places of a ranking are returned."""

_GOLDEN_RATIO = (5**0.5 - 1) / 2


def spread_order(count: int) -> Positions:
    """A permutation of 0 … count - 1, int64 [count], of which every prefix is spread evenly over the whole range."""
    return np.argsort((np.arange(count) * _GOLDEN_RATIO) % 1.0, kind="stable").astype(np.int64)


class SelfQueries:
    """The places of a map at one moment as queries; a position is the index of a place in the order of the rows.

    places: id, row and fields of each place.
    rows: int64 [places], the rows of the places in ``snapshot``.
    where: the poses and sequences of the places, without poses that an alignment has handed over.
    """

    def __init__(self, map_: Map, encoder: Encoder) -> None:
        self.encoder, self.neighborhood = encoder, neighborhood_of(map_)
        outline = map_.transfer.outline()
        self.snapshot = map_.snapshot()
        # A place that is being stored at this moment is listed before its row is in a snapshot.
        there = (place for place in outline if place.row < self.snapshot.rows)
        self.places: list[Outline] = sorted(there, key=lambda place: place.row)
        self.rows = np.array([place.row for place in self.places], np.int64)
        self.where = own_poses(map_.counterparts, self.snapshot.whereabouts_at(self.rows), self.rows)
        self._position = np.full(self.snapshot.rows, -1, np.int64)
        self._position[self.rows] = np.arange(len(self.rows))

    def __len__(self) -> int:
        return len(self.places)

    def members(self, positions: Positions) -> NDArray[np.bool_]:
        """Which of all places are at some positions, int64 [k]; bool [places]."""
        found = np.zeros(len(self), np.bool_)
        found[positions] = True
        return found

    def near(self, position: int, others: Positions, times: float = 1) -> NDArray[np.bool_]:
        """Which of the places at ``others``, int64 [n], are the same place as the one at ``position``; bool [n].

        Args:
            times: how many times as far as the map says.
        """
        neighborhood = self.neighborhood if times == 1 else self.neighborhood.times(times)
        return self.where.take(np.concatenate([[position], others])).near(0, neighborhood)[1:]

    def local_descriptors(self, positions: Positions) -> Cells:
        """The local descriptors of the places at some positions, int64 [k]; int8 [k, C, L]."""
        return self.snapshot.locals_at(self.rows[positions])

    def first_stage_scores(self, pairs: Positions) -> NDArray[np.float32]:
        """The scores of the first stage for pairs of positions; int64 [m, 2] to float32 [m]."""
        wanted, inverse = np.unique(pairs, return_inverse=True)
        inverse = inverse.reshape(pairs.shape)
        descriptors = self.snapshot.descriptors_at(self.rows[wanted])
        products = np.einsum("md,md->m", descriptors[inverse[:, 0]], descriptors[inverse[:, 1]])
        return np.asarray(self.encoder.scores_from_inner_products(products), np.float32)

    def search(
        self, positions: Sequence[int], references: NDArray[np.bool_] | None = None
    ) -> Iterator[tuple[int, Positions, NDArray[np.float32]]]:
        """Search the map, by the first stage, for some of its own places.

        Args:
            positions: the queries, at most ``TOGETHER``.
            references: bool [places], the places that are searched; None: all.

        Yields:
            For each query its position, the positions of the best other places, int64 [n], best first, and their
            scores, float32 [n].
        """
        allowed = self.snapshot.alive
        if references is not None:
            allowed = np.zeros(self.snapshot.rows, np.bool_)
            allowed[self.rows[references]] = True
        chosen = np.asarray(positions, np.int64)
        descriptors = self.snapshot.descriptors_at(self.rows[chosen])
        for position, (rows, products) in zip(positions, self.snapshot.among(allowed).search(descriptors), strict=True):
            found = self._position[rows[: HEAD + 1]]
            others = (found >= 0) & (found != position)
            scores = self.encoder.scores_from_inner_products(products[: HEAD + 1])
            yield position, found[others], scores[others]
