"""The second stage: do two frames agree cell by cell, if what moved has moved only a little?

VLAD forgets where in the frame a feature was.  For the first few candidates of its ranking, the local descriptors D^L
of both frames (thesis, equations 3.1 and 4.1) are therefore compared on the grid of cells.  A cell of the query and a
cell of the reference correspond when each is the other's best match within reach: they are mutual nearest neighbours,
as the thesis's Figure 3.1 shows by eye.  :func:`correspondences` finds them in plain NumPy.  With the cosines c of the
corresponding cells, C cells in all, a candidate's score grows by

    share · 1/C Σ c²,

which :func:`agreement` computes for many candidates at once with a compiled loop.  More places than can be compared so
may be screened first: :func:`promise` selects these from a sample of their cells.

The common part of all cells of a frame, as its light and weather, may be taken from them before they are compared
(:func:`standardized`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.kernels.correspondence import sampled_squares, squared_sums
from core.method.equations import unit_length

Array = NDArray[np.float32]
Cells = NDArray[np.int8]
"""Local descriptors, quantised: int8 [C, L], or [k, C, L] of several frames."""

RESOLUTION = 254.0
"""Steps of 1 / RESOLUTION quantise the values of local descriptors; values of half a unit and more, which are rare,
become 127."""

STEADINESS = 0.5
"""So much of the mean deviation is added to each deviation that values are divided by, so that values which hardly
differ within a frame do not become its largest."""


class AgreementDefinition(BaseModel):
    """The second stage of an encoder.

    ``layers`` share one grid; ``values`` of each are retained, and its cosine counts by its ``weights``.
    ``reach`` is how far a cell may have moved, in rows and columns.  ``candidates`` are examined; the mean squared
    cosine over all cells makes up ``share`` of their score, the first stage's score the rest.  They are the first of
    the ranking or, if more places are ``screened``, the most promising of these.  ``centred`` is the share of its mean
    over the frame that each value of a cell loses before it is divided by its deviation over the frame; None: cells
    stay as they are.  Cells that are ``taught`` have projections of their own, others those of the
    regions.  Encoders of other people's networks have none of the three.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    layers: tuple[str, ...] = Field(min_length=1)
    values: int = Field(ge=1, le=4096)
    weights: tuple[float, ...]
    reach: tuple[int, int]
    candidates: int = Field(ge=1, le=1000)
    share: float = Field(gt=0, lt=1)
    centred: float | None = Field(default=None, ge=0, le=1)
    screened: int | None = Field(default=None, ge=1, le=1000)
    taught: bool | None = None

    @model_validator(mode="after")
    def _one_weight_a_layer(self) -> AgreementDefinition:
        if len(self.weights) != len(self.layers) or not all(0 < weight <= 1 for weight in self.weights):
            raise ValueError("each layer needs one weight over 0 and at most 1")
        if abs(sum(self.weights) - 1) > 1e-6 or min(self.reach) < 0:
            raise ValueError("the weights add up to 1 and the reach is not negative")
        if self.screened is not None and self.screened <= self.candidates:
            raise ValueError("more places are screened than examined")
        return self

    @property
    def length(self) -> int:
        """L, the number of values of one cell."""
        return self.values * len(self.layers)


def local_descriptors(layers: list[Array], definition: AgreementDefinition) -> Cells:
    """Quantise the projected features of C cells, so that inner products are weighted sums of cosines.

    A value v of a layer with the weight w becomes the whole number nearest to v · √w · RESOLUTION, from -127 to 127.
    Cells are standardized before, if the definition says so.

    Args:
        layers: float32 [C, values] each, rows of unit length or zero.

    Returns:
        int8 [C, L].
    """
    cells = np.stack(layers, axis=1)
    shown = cells if definition.centred is None else standardized(cells, definition.centred)
    steps = shown * (np.float32(RESOLUTION) * np.sqrt(np.array(definition.weights)))[:, np.newaxis].astype(np.float32)
    np.clip(np.rint(steps, out=steps), -127, 127, out=steps)
    return steps.astype(np.int8).reshape(len(cells), -1)


def standardized(cells: Array, centred: float) -> Array:
    """Each value less a share of its mean over the cells of a frame, by its deviation over them, to unit length.

    Args:
        cells: float32 [C, values] or, of several layers, [C, layers, values]; rows of unit length or zero; rows of
            zeros take no part and stay.
        centred: the share of the mean.

    Returns:
        float32, of the same shape.
    """
    seen = cells.any(axis=-1, keepdims=True)
    count = np.maximum(seen.sum(axis=0), 1).astype(np.float32)
    mean = cells.sum(axis=0) / count
    squares = np.square((cells - mean) * seen)
    deviation = np.sqrt(squares.sum(axis=0) / count)
    steady = deviation + np.float32(STEADINESS) * deviation.mean(axis=-1, keepdims=True) + np.float32(1e-12)
    made = (cells - np.float32(centred) * mean) / steady * seen
    return np.asarray(unit_length(made.reshape(-1, made.shape[-1])).reshape(made.shape), np.float32)


@dataclass(frozen=True)
class Correspondences:
    """Cells of two frames that are each other's best match.

    query, reference: int64 [n], cells of the two frames (row * columns + column), ascending in the query.
    cosines: float32 [n], each over 0.
    """

    query: NDArray[np.int64]
    reference: NDArray[np.int64]
    cosines: Array


def correspondences(query: Cells, reference: Cells, columns: int, reach: tuple[int, int]) -> Correspondences:
    """The mutual nearest neighbours among the cells of two frames.

    Args:
        query, reference: int8 [C, L].
        columns: of the grid; C is a multiple of it.
        reach: rows and columns by which two corresponding cells may be apart.
    """
    products = query.astype(np.float64) @ reference.astype(np.float64).T  # C x C, exact
    cells = np.arange(len(query))
    row, column = np.divmod(cells, columns)
    far = (np.abs(row[:, None] - row) > reach[0]) | (np.abs(column[:, None] - column) > reach[1])
    products[far] = -np.inf
    there, back = products.argmax(axis=1), products.argmax(axis=0)  # of equal products the lower cell's
    best = products[cells, there]
    mutual = (back[there] == cells) & (best > 0)
    return Correspondences(cells[mutual], there[mutual], (best[mutual] / RESOLUTION**2).astype(np.float32))


def agreement(query: Cells, candidates: Cells, columns: int, definition: AgreementDefinition) -> Array:
    """The gain of each candidate's score: ``share`` times the mean over all cells of the squared cosines.

    Args:
        query: int8 [C, L].
        candidates: int8 [k, C, L].
        columns: of the grid; C is a multiple of it.

    Returns:
        float32 [k], at least 0 and, except for rounding, at most ``share``.

    Raises:
        ValueError: the query's cells and the candidates' have different shapes, or do not fill such a grid.
    """
    queried, shown = _comparable(query, candidates, columns)
    sums: Array = squared_sums(queried, shown, columns, *definition.reach, np.float32(1 / RESOLUTION**2))
    return sums * np.float32(definition.share / len(query))


def promise(query: Cells, candidates: Cells, columns: int, definition: AgreementDefinition) -> Array:
    """About what each candidate's score would gain: ``share`` times the mean squared cosine of a sample of its cells.

    Each cell of the sample has the query's best one within reach, which need not be mutual.  It takes an eighth
    of the time of :func:`agreement`.

    Args:
        query: int8 [C, L].
        candidates: int8 [k, C, L].
        columns: of the grid; C is a multiple of it.

    Returns:
        float32 [k], at least 0.

    Raises:
        ValueError: the query's cells and the candidates' have different shapes, or do not fill such a grid.
    """
    queried, shown = _comparable(query, candidates, columns)
    means: Array = sampled_squares(queried, shown, columns, *definition.reach, np.float32(1 / RESOLUTION**2))
    return means * np.float32(definition.share)


def _comparable(query: Cells, candidates: Cells, columns: int) -> tuple[Cells, Cells]:
    """Both as the compiled loops take them; numba would compile these again for arrays that are read-only or not
    contiguous."""
    if query.shape != candidates.shape[1:] or len(query) % columns:
        shapes = f"{list(query.shape)} and {list(candidates.shape[1:])}"
        raise ValueError(f"cells of {shapes} in {columns} columns cannot be compared")
    queried, shown = (np.require(cells, np.int8, ["C", "W"]) for cells in (query, candidates))
    return queried, shown
