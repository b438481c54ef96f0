"""The compiled loop of ``core.geometry.detection``: values of a map between its cells."""

from __future__ import annotations

import numba
import numpy as np

SHARPNESS = np.float32(-0.75)
"""The constant of cubic convolution (Keys, 1981), as in the authors' code of XFeat."""


@numba.njit(cache=True, nogil=True)
def _weights(share, weights):  # type: ignore[no-untyped-def]
    """The weights of the four cells around a position that is ``share`` of a cell behind the second."""
    a = SHARPNESS
    for tap in range(4):
        away = abs(share + np.float32(1 - tap))
        if away <= 1:
            weights[tap] = ((a + 2) * away - (a + 3)) * away * away + 1
        else:
            weights[tap] = ((a * away - 5 * a) * away + 8 * a) * away - 4 * a


@numba.njit(cache=True, nogil=True)
def interpolated(maps, rows, columns):  # type: ignore[no-untyped-def]
    """The values at positions, interpolated by cubic convolution; outside of the map they are 0.

    Args:
        maps: float32 [R, C, K].
        rows, columns: float32 [n], positions in cells, whose centres are whole numbers.

    Returns:
        float32 [n, K].
    """
    found = np.zeros((len(rows), maps.shape[2]), np.float32)
    down, across = np.empty(4, np.float32), np.empty(4, np.float32)
    for i in range(len(rows)):
        row, column = np.floor(rows[i]), np.floor(columns[i])
        _weights(rows[i] - row, down)
        _weights(columns[i] - column, across)
        for r in range(4):
            y = np.int64(row) + r - 1
            if not 0 <= y < maps.shape[0]:
                continue
            for c in range(4):
                x = np.int64(column) + c - 1
                if 0 <= x < maps.shape[1]:
                    weight = down[r] * across[c]
                    for k in range(maps.shape[2]):
                        found[i, k] += weight * maps[y, x, k]
    return found
