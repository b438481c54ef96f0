"""The compiled loops of ``core.method.projection`` after the products with a matrix."""

from __future__ import annotations

import numba
import numpy as np


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
