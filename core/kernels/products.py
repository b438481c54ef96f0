"""Products of many short vectors with one matrix that never changes, by oneDNN."""

from __future__ import annotations

from typing import Any

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
