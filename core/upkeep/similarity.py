"""How alike the frames of two traverses are: the scores of all pairs, the way through them, and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.judgement.alignment import LARGEST_STEP, SharedStretch, of_matrix, shared_stretches
from core.maps import Snapshot
from core.method.encoder import Encoder
from core.places import NO_POSE, NO_SEQUENCE, Whereabouts

Rows = NDArray[np.int64]

BLOCK, TILE = 2048, 1024
"""So many descriptors of the shorter and of the longer traverse are in memory at a time."""

NONE = -1
"""The column of a frame that has none."""


def score_pairs(snapshot: Snapshot, encoder: Encoder, queries: Rows, references: Rows) -> NDArray[np.float32]:
    """The first stage's score of every frame of one traverse with every frame of another.

    The second stage is left out: it compares the cells of two frames for some microseconds, which is too long for
    millions of pairs; it would raise the scores of the best pairs.

    Args:
        queries, references: rows of the snapshot, int64 [Q] and [R].

    Returns:
        float32 [Q, R].

    Raises:
        UnknownPlace: a place is gone.
        StorageFailure: the map's files cannot be read.
    """
    products = np.empty((len(queries), len(references)), np.float32)
    few, many = (queries, references) if len(queries) <= len(references) else (references, queries)
    for start in range(0, len(few), BLOCK):
        some = snapshot.descriptors_at(few[start : start + BLOCK])
        for first in range(0, len(many), TILE):
            found = some @ snapshot.descriptors_at(many[first : first + TILE]).T
            rows, columns = slice(start, start + len(some)), slice(first, first + found.shape[1])
            if few is queries:
                products[rows, columns] = found
            else:
                products[columns, rows] = found.T
    return encoder.scores_from_inner_products(products)


@dataclass(frozen=True)
class GreyScale:
    """Scores as 8-bit values: a score is ``low`` + value / 255 · (``high`` - ``low``), rounded to the next value."""

    low: float
    high: float

    @classmethod
    def of(cls, scores: NDArray[np.float32]) -> GreyScale:
        """The scale from the lowest to the highest score; of no scores, from 0 to 0."""
        return cls(float(scores.min()), float(scores.max())) if scores.size else cls(0.0, 0.0)

    def values(self, scores: NDArray[np.float32]) -> NDArray[np.uint8]:
        """The values of scores, uint8 of their shape; zeros if all scores are equal."""
        if self.high <= self.low:
            return np.zeros(scores.shape, np.uint8)
        return np.rint((scores.astype(np.float64) - self.low) * 255 / (self.high - self.low)).astype(np.uint8)


def stretches_of(scores: NDArray[np.float32]) -> list[SharedStretch]:
    """The stretches that two traverses share by their scores, best first, with rows as ``first``.

    If the second traverse has so many more frames that a path could not keep up with it, its frames are matched with
    those of the first.

    Args:
        scores: float32 [Q, R].
    """
    rows, columns = scores.shape
    if columns <= LARGEST_STEP * rows:
        return shared_stretches(of_matrix(scores), rows, columns)
    turned = shared_stretches(of_matrix(scores.T), columns, rows)
    return [SharedStretch(one.second, one.first, one.gain) for one in turned]


def nearest_by_pose(queries: Whereabouts, references: Whereabouts, radius: float) -> Rows | None:
    """The column of the nearest reference of each query by their poses, int64 [Q]; NONE if none is within ``radius``.

    None if not a single pair of them has poses of one kind.

    Args:
        radius: metres.
    """
    from scipy.spatial import cKDTree  # here, because it takes long to import

    found = np.full(len(queries), NONE, np.int64)
    comparable = False
    for kind in np.unique(queries.kind[queries.kind != NO_POSE]):
        rows, columns = np.flatnonzero(queries.kind == kind), np.flatnonzero(references.kind == kind)
        if not len(columns):
            continue
        comparable = True
        apart, nearest = cKDTree(references.position[columns]).query(queries.position[rows])
        found[rows] = np.where(apart <= radius, columns[nearest], NONE)
    return found if comparable else None


def counterparts(queries: Whereabouts, references: Whereabouts) -> Rows:
    """The column of a reference at the same station as each query, as alignment found it, int64 [Q]; NONE without one.

    Of several, it is the first.  Frames of one traverse are no counterparts of one another.
    """
    at: dict[tuple[int, int], int] = {}
    for column in range(len(references) - 1, -1, -1):
        if references.track[column] != NO_SEQUENCE:
            at[int(references.track[column]), int(references.station[column])] = column
    found = np.full(len(queries), NONE, np.int64)
    for row in range(len(queries)):
        column = at.get((int(queries.track[row]), int(queries.station[row])), NONE)
        if column != NONE and references.sequence[column] != queries.sequence[row]:
            found[row] = column
    return found
