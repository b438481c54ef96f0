"""The compiled loops over the pixels of a frame."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def normalize(pixels, mean, scale, out):  # type: ignore[no-untyped-def]
    """Put (pixels - mean) · scale into ``out``.

    Args:
        pixels: uint8 [H, W, 3].
        mean, scale: float32 [3 W], of the three channels of each pixel of a row.
        out: float32 [H, 3 W].
    """
    rows = pixels.reshape(out.shape)
    for y in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[y, i] = (np.float32(rows[y, i]) - mean[i]) * scale[i]


@numba.njit(cache=True, nogil=True)
def largest_deviation(values):  # type: ignore[no-untyped-def]
    """The largest standard deviation of a column, of uint8 [n, 3], n > 0."""
    largest = 0.0
    for channel in range(3):
        total, squares = 0, 0  # exact
        for i in range(len(values)):
            value = int(values[i, channel])
            total += value
            squares += value * value
        mean = total / len(values)
        largest = max(largest, squares / len(values) - mean * mean)
    return np.sqrt(largest)
