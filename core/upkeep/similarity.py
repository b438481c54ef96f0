"""How alike the frames of two traverses are: the scores of all pairs, the way through them, and its figures."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.judgement.alignment import LARGEST_STEP, SharedStretch, of_matrix, shared_stretches
from core.method.encoder import Encoder
from core.places import NO_POSE, NO_SEQUENCE, Neighborhood, Whereabouts
from core.store import Snapshot
from core.threads import allowed_threads, compute_alone, in_turns

Rows = NDArray[np.int64]

BLOCK, TILE = 2048, 512
"""Number of descriptors of the shorter traverse in memory at a time, and of the longer one for each thread."""

ROWS = 128
"""Number of rows of a matrix processed at a time where intermediate results would take a multiple of its memory."""

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
    across = products if few is queries else products.T
    threads = allowed_threads()
    with ThreadPoolExecutor(threads, "scores", compute_alone) as helpers:
        for start in range(0, len(few), BLOCK):
            rows = few[start : start + BLOCK]
            some = np.empty((len(rows), encoder.dimension), np.float32)

            def read(part: slice, rows: Rows = rows, some: NDArray[np.float32] = some) -> None:
                some[part] = snapshot.descriptors_at(rows[part])

            def score(part: slice, start: int = start, some: NDArray[np.float32] = some) -> None:
                found = some @ snapshot.descriptors_at(many[part]).T
                across[start : start + len(some), part] = encoder.scores_from_inner_products(found)

            in_turns(read, _parts(len(rows), ROWS), helpers, threads - 1)
            in_turns(score, _parts(len(many), TILE), helpers, threads - 1)
    return products


def _parts(count: int, size: int) -> list[slice]:
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]


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
        values = np.zeros(scores.shape, np.uint8)
        if self.high > self.low:
            for part in _parts(len(scores), ROWS):
                some = (scores[part].astype(np.float64) - self.low) * 255 / (self.high - self.low)
                values[part] = np.rint(some)
        return values


def stretches_of(scores: NDArray[np.float32]) -> list[SharedStretch]:
    """The stretches that two traverses share by their scores, best first, with rows as ``first``.

    If the second traverse has too many frames for a path to keep up with it, its frames are matched with
    those of the first.

    Args:
        scores: float32 [Q, R].
    """
    rows, columns = scores.shape
    if columns <= LARGEST_STEP * rows:
        return shared_stretches(of_matrix(scores), rows, columns)
    turned = shared_stretches(of_matrix(scores.T), columns, rows)
    return [SharedStretch(one.second, one.first, one.gain) for one in turned]


def nearest_by_pose(queries: Whereabouts, references: Whereabouts, neighborhood: Neighborhood) -> Rows | None:
    """The column of the nearest reference of each query by their poses, int64 [Q]; NONE if none is the same place.

    None if not a single pair of them has poses of one kind.
    """
    found = np.full(len(queries), NONE, np.int64)
    both, ground = Whereabouts.joined([queries, references]), (queries.ground, references.ground)
    comparable = False
    for kind in np.unique(queries.kind[queries.kind != NO_POSE]):
        rows, columns = np.flatnonzero(queries.kind == kind), np.flatnonzero(references.kind == kind)
        if not len(columns):
            continue
        comparable = True
        for part in _parts(len(rows), ROWS):
            some = rows[part]
            apart = ground[0][some, np.newaxis] - ground[1][columns]
            squares = np.einsum("qrc,qrc->qr", apart, apart)
            above = both.on_other_levels(some[:, np.newaxis], len(queries) + columns, neighborhood.height)
            squares[above] = np.inf
            nearest = squares.argmin(axis=1)
            near = np.sqrt(squares[np.arange(len(some)), nearest]) <= neighborhood.radius
            found[some] = np.where(near, columns[nearest], NONE)
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
