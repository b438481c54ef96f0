"""The compiled loops of ``core.method.projection``: rows centred and brought to unit length."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def squared_length(feature):  # type: ignore[no-untyped-def]
    """|f|²; float32 [K]."""
    square = np.float32(0)
    for k in range(len(feature)):
        square += feature[k] * feature[k]
    return square


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def finish_row(products, square, shift, projected):  # type: ignore[no-untyped-def]
    """One row of ``Projection.finish``; float32 [d], |f|² and float32 [d] to float32 [values]."""
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
    """Row by row, as ``Projection.finish``, into ``projected``, float32 [n, values]."""
    for i in range(len(features)):
        finish_row(products[i], squared_length(features[i]), shift, projected[i])
