"""Inner products with descriptors of six bits a value, which are not unpacked first.

Such a descriptor consists of blocks of 128 values, each with a scale.  A value is (4 h + l - 32) times its block's
scale.  The upper four bits h are stored two values a byte, the lower two bits l four values a byte, with the first
value in the lowest bits.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

BLOCK = 128
_FOURS = BLOCK // 4


def packed_products(query: Array, scales: Array, uppers: NDArray[np.uint8], lowers: NDArray[np.uint8]) -> Array:
    """Inner products of a query with n descriptors, float32 [n].

    Args:
        query: float32 [128·b], with zeros appended to its D values.
        scales: float32 [n, b].
        uppers: uint8 [n, 64·b]; the rows need not be adjacent in memory.
        lowers: uint8 [n, 32·b], likewise.
    """
    blocks = query.reshape(-1, _FOURS, 4)
    # The contribution of the subtracted 32 is the same for every descriptor, except for the scales.
    offsets = np.float32(32) * blocks.sum(axis=(1, 2), dtype=np.float32)
    made = np.empty(len(scales), np.float32)
    _products(np.ascontiguousarray(blocks.transpose(0, 2, 1)), offsets, scales, uppers, lowers, made)
    return made


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _products(query, offsets, scales, uppers, lowers, made):  # type: ignore[no-untyped-def]
    """``query``: float32 [b, 4, 32], of every block the first of each group of four values, then the second, …"""
    for row in range(len(scales)):
        total = np.float32(0)
        for block in range(len(query)):
            upper = uppers[row, 64 * block : 64 * block + 64]
            lower = lowers[row, 32 * block : 32 * block + 32]
            found = np.float32(0)
            for j in range(_FOURS):
                first, second, rest = np.int32(upper[2 * j]), np.int32(upper[2 * j + 1]), np.int32(lower[j])
                found += query[block, 0, j] * np.float32(((first & 15) << 2) + (rest & 3))
                found += query[block, 1, j] * np.float32(((first >> 4) << 2) + ((rest >> 2) & 3))
                found += query[block, 2, j] * np.float32(((second & 15) << 2) + ((rest >> 4) & 3))
                found += query[block, 3, j] * np.float32(((second >> 4) << 2) + (rest >> 6))
            total += scales[row, block] * (found - offsets[block])
        made[row] = total
