"""Products of many short vectors with one matrix, and the loops of ``core.method.projection`` after them."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float32]

TYPICAL = 300
"""Number of vectors for which oneDNN chooses the matrix's layout."""


class ConstantMatrix:
    """x W + b, with W in the layout that oneDNN's loop reads; where oneDNN has no such product, NumPy's is used.

    Args:
        matrix: W, float32 [K, d].
        offset: b, float32 [d]; None: zero.
    """

    def __init__(self, matrix: Array, offset: Array | None = None) -> None:
        self._matrix, self._offset = matrix, offset
        self._bias = None if offset is None else torch.from_numpy(np.ascontiguousarray(offset))
        self._ordered = _ordered(matrix)

    def __call__(self, vectors: Array) -> Array:
        """Multiply vectors, float32 [n, K] to float32 [n, d]."""
        if self._ordered is None or len(vectors) == 0:
            products = np.asarray(vectors @ self._matrix, np.float32)
            return products if self._offset is None else products + self._offset
        run: Any = torch.ops.mkldnn._linear_pointwise
        with torch.inference_mode():
            given = torch.from_numpy(np.ascontiguousarray(vectors))
            made: Array = run(given, self._ordered, self._bias, "none", [], "").numpy()
        return made


def _ordered(matrix: Array) -> Tensor | None:
    """The matrix in oneDNN's layout; None if this build of torch or this processor has no such product."""
    try:
        with torch.inference_mode():
            transposed = torch.from_numpy(np.ascontiguousarray(matrix.T))
            ordered: Tensor = torch.ops.mkldnn._reorder_linear_weight(transposed, TYPICAL)
            blank = torch.zeros(1, len(matrix))
            torch.ops.mkldnn._linear_pointwise(blank, ordered, None, "none", [], "")
    except (RuntimeError, AttributeError):
        return None
    return ordered


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def squared_length(feature):  # type: ignore[no-untyped-def]
    """|f|² of f, float32 [K]."""
    square = np.float32(0)
    for k in range(len(feature)):
        square += feature[k] * feature[k]
    return square


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def finish_row(products, square, shift, projected):  # type: ignore[no-untyped-def]
    """Put f W / |f| - m W at unit length into ``projected``; zeros where f is zero.

    Args:
        products: f W, float32 [d].
        square: |f|².
        shift: m W, float32 [d].
        projected: float32 [values], values <= d.
    """
    inverse = np.float32(1) / np.sqrt(square) if square > 0 else np.float32(0)
    square = np.float32(0)
    for d in range(len(projected)):
        value = products[d] * inverse - shift[d]
        projected[d] = value
        square += value * value
    again = np.float32(1) / np.sqrt(square) if square > 0 and inverse > 0 else np.float32(0)
    for d in range(len(projected)):
        projected[d] *= again


@numba.njit(cache=True, nogil=True)
def finish_rows(products, features, shift, projected):  # type: ignore[no-untyped-def]
    """The same for each row: float32 [n, d], [n, K] and [d] to float32 [n, values]."""
    for i in range(len(features)):
        finish_row(products[i], squared_length(features[i]), shift, projected[i])


@numba.njit(cache=True, nogil=True)
def quantize(values, factor, made):  # type: ignore[no-untyped-def]
    """Put values times a factor, rounded and cut off at ±127, into ``made``; float32 [C, n] to int8 [C, n]."""
    for c in range(values.shape[0]):
        for i in range(values.shape[1]):
            made[c, i] = np.int8(min(127.0, max(-127.0, np.rint(values[c, i] * factor))))
