"""A random rotation, seeded, in D log D steps.

The values of a descriptor are unequal: a word that the frame lacks leaves zeros in a row.  A random rotation spreads
the content evenly over all values, so that each of them is worth one bit (RaBitQ: Gao and Long, SIGMOD 2024, section
3.1.2).  Random signs followed by a fast Hadamard transform serve as one (Ailon and Chazelle, STOC 2006); where D is no
power of two, the first values and the last ones are transformed in turn, four times in all.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

ROUNDS = 4
"""Transforms of a dimension that is no power of two; one is enough for any other."""


def random_signs(dimension: int, seed: int) -> Array:
    """float32 [rounds, D] of 1 and -1; the same for a seed on every machine."""
    rounds = 1 if _window(dimension) == dimension else ROUNDS
    draws = np.random.PCG64(seed).random_raw(rounds * dimension) >> np.uint64(63)
    return (1 - 2 * draws.astype(np.float32)).reshape(rounds, dimension)


def rotated(vectors: Array, signs: Array) -> Array:
    """An orthogonal transform of each row.

    Args:
        vectors: float32 [n, D].
        signs: float32 [rounds, D], of :func:`random_signs`.

    Returns:
        float32 [n, D]; inner products between rows are as before, but for rounding.
    """
    turned = np.array(vectors, np.float32, order="C")
    _rotate(turned, signs, _window(turned.shape[1]))
    return turned


def _window(dimension: int) -> int:
    """The largest power of two up to D."""
    return 1 << (dimension.bit_length() - 1)


@numba.njit(cache=True, nogil=True)
def _rotate(rows, signs, window):  # type: ignore[no-untyped-def]
    dimension = rows.shape[1]
    scale = np.float32(1 / np.sqrt(window))
    here, there = np.empty(window, np.float32), np.empty(window, np.float32)
    for row in rows:
        for turn in range(len(signs)):
            start = 0 if turn % 2 == 0 else dimension - window
            for k in range(dimension):
                row[k] *= signs[turn, k]
            here[:] = row[start : start + window]
            half, size = window // 2, 1
            while size < window:
                # Every step of the transform is the same loop, over neighbours in pairs: this is what vectorises.
                for k in range(half):
                    a, b = here[2 * k], here[2 * k + 1]
                    there[k], there[half + k] = a + b, a - b
                here, there = there, here
                size *= 2
            for k in range(window):
                row[start + k] = here[k] * scale
