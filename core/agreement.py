"""The second stage: do two frames agree cell by cell, with what moved having moved a little?

VLAD forgets where in the frame a feature was.  For the first few candidates that it ranks, the local
descriptors D^L of both frames are held against each other on the grid of cells: a cell of the query and a cell of
the reference correspond when each is the other's best match within reach (mutual nearest neighbours, as the
thesis's Figure 3.1 shows by eye), and each such pair adds the square of its cosine.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

Array = NDArray[np.float32]
Cells = NDArray[np.int8]

RESOLUTION = 254.0
"""Quantisation of local descriptors: values of half a unit and more, which hardly occur, become 127."""

_COSINE = np.float32(1 / RESOLUTION**2)
"""What the inner product of two cells' values is multiplied by to be their cosine."""

TOGETHER = 32
"""Candidates compared at a time, so that memory stays bounded."""


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


@numba.njit(cache=True, nogil=True)
def _squared_sums(products, columns, rows_apart, columns_apart):  # type: ignore[no-untyped-def]
    """Σ cos² over the mutual best matches of each of k candidates; inner products float32 or int32 [k, C, C]."""
    count, cells = len(products), products.shape[1]
    sums = np.zeros(count, np.float32)
    there, back = np.empty(cells, np.int64), np.empty(cells, np.int64)
    for k in range(count):
        _best_within(products[k], columns, rows_apart, columns_apart, there)
        _best_within(products[k].T, columns, rows_apart, columns_apart, back)
        for cell in range(cells):
            match = there[cell]
            value = np.float32(products[k, cell, match]) * _COSINE
            if back[match] == cell and value > 0:
                sums[k] += value * value
    return sums


def _float_products(candidates: Cells, query: Cells) -> NDArray[Any]:
    """Inner products of cells, float32 [n, C]: exact, as the sums of L products stay under 2^24 for L up to 1 040."""
    return np.asarray(candidates.astype(np.float32) @ query.astype(np.float32).T)


def _integer_products(candidates: Cells, query: Cells) -> NDArray[Any]:
    """The same in int32, where the processor multiplies bytes."""
    product: torch.Tensor = torch._int_mm(torch.from_numpy(candidates), torch.from_numpy(query.T))
    return np.asarray(product.numpy())


@cache
def _products() -> Callable[[Cells, Cells], NDArray[Any]]:
    """The faster of the two on this machine, which make no difference to the result."""
    random = np.random.default_rng(0)
    candidates, query = (random.integers(-127, 128, (count, 192)).astype(np.int8) for count in (2028, 169))
    best: dict[Callable[[Cells, Cells], NDArray[Any]], float] = {}
    for make in (_float_products, _integer_products) * 4:
        began = time.perf_counter()
        try:
            make(candidates, query)
        except (AttributeError, RuntimeError, NotImplementedError):  # not in this build of torch
            continue
        best[make] = min(best.get(make, np.inf), time.perf_counter() - began)
    return min(best, key=best.__getitem__)


def _inner_products(query: Cells, candidates: Cells) -> NDArray[Any]:
    """float32 or int32 [k, C, C]: cells of each candidate down, those of the query across."""
    k, cells, length = candidates.shape
    rows = np.ascontiguousarray(candidates).reshape(k * cells, length)
    return _products()(rows, np.ascontiguousarray(query)).reshape(k, cells, cells)


def agreement(query: Cells, candidates: Cells, columns: int, definition: AgreementDefinition) -> Array:
    """What each candidate gains: ``share`` times the mean over cells of its mutual matches' squared cosines.

    Args:
        query: int8 [C, L].
        candidates: int8 [k, C, L].
        columns: of the grid; C is a multiple of it.

    Returns:
        float32 [k], at least 0, at most ``share`` but for rounding.
    """
    if len(candidates) == 0:
        return np.zeros(0, np.float32)
    sums = [
        _squared_sums(_inner_products(query, candidates[start : start + TOGETHER]), columns, *definition.reach)
        for start in range(0, len(candidates), TOGETHER)
    ]
    return np.asarray(np.concatenate(sums) * np.float32(definition.share / len(query)), np.float32)


def correspondences(query: Cells, reference: Cells, columns: int, definition: AgreementDefinition) -> Correspondences:
    """Which cell of the query answers to which of the reference; both int8 [C, L]."""
    cosines = _float_products(reference, query) * _COSINE  # reference x query
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
