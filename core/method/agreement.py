"""The second stage: do two frames agree cell by cell, with what moved having moved a little?

VLAD forgets where in the frame a feature was.  For the first few candidates that it ranks, the local
descriptors D^L of both frames are held against each other on the grid of cells: a cell of the query and a cell of
the reference correspond when each is the other's best match within reach (mutual nearest neighbours, as the
thesis's Figure 3.1 shows by eye), and each such pair adds the square of its cosine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.kernels.correspondence import WHOLE_WORDS, squared_sums
from core.method.cells import Cells as Cells
from core.method.cells import ScatteredCells, in_one_block

Array = NDArray[np.float32]

RESOLUTION = 254.0
"""Quantisation of local descriptors: values of half a unit and more, which hardly occur, become 127."""

_COSINE = np.float32(1 / RESOLUTION**2)
"""What the inner product of two cells' values is multiplied by to be their cosine."""


class AgreementDefinition(BaseModel):
    """The second stage of an encoder.

    ``layers`` share one grid; ``values`` of each are kept, and its cosine counts by its ``weights``.
    ``reach`` is how far a cell may have moved, in rows and columns.  ``candidates`` are examined; the mean squared
    cosine over all cells makes up ``share`` of their score, the first stage's score the rest.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    layers: tuple[str, ...] = Field(min_length=1)
    values: int = Field(ge=1, le=4096)
    weights: tuple[float, ...]
    reach: tuple[int, int]
    candidates: int = Field(ge=1, le=1000)
    share: float = Field(gt=0, lt=1)

    @model_validator(mode="after")
    def _one_weight_a_layer(self) -> AgreementDefinition:
        if len(self.weights) != len(self.layers) or not all(0 < weight <= 1 for weight in self.weights):
            raise ValueError("each layer needs one weight over 0 and at most 1")
        if abs(sum(self.weights) - 1) > 1e-6 or min(self.reach) < 0:
            raise ValueError("the weights add up to 1 and the reach is not negative")
        return self

    @property
    def length(self) -> int:
        """L, the values of one cell."""
        return self.values * len(self.layers)


def local_descriptors(layers: list[Array], definition: AgreementDefinition) -> Cells:
    """The projected unit features of C cells, int8 [C, L], so that inner products are weighted sums of cosines.

    Args:
        layers: float32 [C, values] each, rows of unit length or zero.
    """
    made = np.empty((len(layers[0]), sum(layer.shape[1] for layer in layers)), np.int8)
    start = 0
    for weight, layer in zip(definition.weights, layers, strict=True):
        stop = start + layer.shape[1]
        _quantize(layer, np.sqrt(weight), made[:, start:stop])
        start = stop
    return made


@numba.njit(cache=True, nogil=True)
def _quantize(values, factor, made):  # type: ignore[no-untyped-def]
    """Values times a factor in steps of 1 / RESOLUTION; float32 [C, n] to int8."""
    for c in range(values.shape[0]):
        for i in range(values.shape[1]):
            made[c, i] = np.int8(min(127.0, max(-127.0, np.rint(values[c, i] * factor * RESOLUTION))))


@dataclass(frozen=True)
class Correspondences:
    """Cells that are each other's best match.

    query, reference: int64 [n], cells of the two frames (row * columns + column).
    cosines: float32 [n], each over 0.
    """

    query: NDArray[np.int64]
    reference: NDArray[np.int64]
    cosines: Array


@numba.njit(cache=True, nogil=True)
def _best_within(cosines, columns, rows_apart, columns_apart, best):  # type: ignore[no-untyped-def]
    """For each cell of the first frame its best match within reach in the second; ties to the lower cell."""
    cells = len(cosines)
    rows = cells // columns
    for cell in range(cells):
        y, x = cell // columns, cell % columns
        highest, found = np.float32(-np.inf), -1
        for v in range(max(0, y - rows_apart), min(rows, y + rows_apart + 1)):
            for u in range(max(0, x - columns_apart), min(columns, x + columns_apart + 1)):
                value = cosines[cell, v * columns + u]
                if value > highest:
                    highest, found = value, v * columns + u
        best[cell] = found


def agreement(query: Cells, candidates: Cells | ScatteredCells, columns: int, definition: AgreementDefinition) -> Array:
    """What each candidate gains: ``share`` times the mean over cells of its mutual matches' squared cosines.

    Args:
        query: int8 [C, L].
        candidates: int8 [k, C, L], in one array or where they lie.
        columns: of the grid; C is a multiple of it.

    Returns:
        float32 [k], at least 0, at most ``share`` but for rounding.

    Raises:
        ValueError: the cells of the query and of the candidates are not alike, or not of such a grid.
    """
    if query.shape != candidates.shape[1:] or len(query) % columns:
        shapes = f"{list(query.shape)} and {list(candidates.shape[1:])}"
        raise ValueError(f"cells of {shapes} in {columns} columns cannot be held against each other")
    if missing := -query.shape[1] % WHOLE_WORDS:
        if isinstance(candidates, ScatteredCells):
            candidates = candidates.together()
        candidates = np.pad(candidates, [(0, 0), (0, 0), (0, missing)])
        query = np.pad(query, [(0, 0), (0, missing)])
    lying = candidates if isinstance(candidates, ScatteredCells) else in_one_block(candidates)
    asked = np.require(query, np.int8, ["C", "W"])  # numba would compile anew for what cannot be written
    sums: Array = squared_sums(asked, lying.addresses(), columns, *definition.reach, _COSINE)
    return sums * np.float32(definition.share / len(query))


def correspondences(query: Cells, reference: Cells, columns: int, definition: AgreementDefinition) -> Correspondences:
    """Which cell of the query answers to which of the reference; both int8 [C, L]."""
    cosines = (reference.astype(np.float32) @ query.astype(np.float32).T) * _COSINE  # reference x query
    there, back = np.empty(len(query), np.int64), np.empty(len(query), np.int64)
    _best_within(cosines.T, columns, *definition.reach, there)
    _best_within(cosines, columns, *definition.reach, back)
    cells = np.arange(len(query))
    values = cosines[there, cells]
    mutual = (back[there] == cells) & (values > 0)
    return Correspondences(cells[mutual], there[mutual], values[mutual])


def reranked(scores: Array, gains: Array) -> tuple[NDArray[np.int64], Array]:
    """The order of a ranking once its first places have gained, and the scores in that order.

    Args:
        scores: float32 [n], best first.
        gains: float32 [k], k <= n, at least 0, of the first k.

    Returns:
        int64 [n], positions in the old ranking, and float32 [n], best first; equal scores keep their order.
    """
    raised = scores.copy()
    raised[: len(gains)] += gains
    order = np.arange(len(scores))
    order[: len(gains)] = np.argsort(-raised[: len(gains)], kind="stable")
    return order, raised[order]
