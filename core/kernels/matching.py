"""The compiled search for the mutual nearest neighbours among the keypoints of one frame and of others.

``core.geometry.matching`` says what is computed.
"""

from __future__ import annotations

import numba
import numpy as np

NUMBER_BITS = 10
"""Bits of a key that hold the number of a keypoint; a product stands above them, so that the highest key has the
highest product and, of equal products, the lowest number.  A product is at most 64 · 127², which takes 20 bits."""

LAST = (1 << NUMBER_BITS) - 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mutual_neighbors(products, width, least):  # type: ignore[no-untyped-def]
    """The mutual nearest neighbours of m keypoints in each of n frames whose products with them are over a bound.

    Args:
        products: float32 [m, n * width], whole numbers; those of one frame are side by side; m and width are at most
            LAST + 1.
        width: keypoints of each frame.
        least: the bound, at least 0.

    Returns:
        int32 [n, m], the number of each keypoint's neighbour in each frame; -1: it has none.
    """
    count = products.shape[0]
    frames = products.shape[1] // width
    found = np.full((frames, count), -1, np.int32)
    of_ours = np.empty(count, np.int32)
    of_theirs = np.empty(width, np.int32)
    for frame in range(frames):
        of_theirs[:] = 0
        start = frame * width
        for i in range(count):
            highest = np.int32(0)
            for j in range(width):
                product = np.int32(max(np.float32(0), products[np.uint64(i), np.uint64(start + j)])) << NUMBER_BITS
                highest = max(highest, np.int32(product | np.int32(LAST - j)))
                of_theirs[j] = max(of_theirs[j], np.int32(product | np.int32(LAST - i)))
            of_ours[i] = highest
        for i in range(count):
            there = LAST - (of_ours[i] & LAST)
            if (of_ours[i] >> NUMBER_BITS) > least and of_theirs[there] & LAST == LAST - i:
                found[frame, i] = there
    return found
