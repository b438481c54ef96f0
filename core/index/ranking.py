"""Rows in the order of their products, the highest first, equal ones by row.

The bits of a float that is not negative are, as an integer, in the order of its value, and those of a negative one in
the opposite order.  Turned round and with the row behind them, they are one integer a row, and integers are what
processors sort fastest, many at a time.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

_ALL_BUT_SIGN = np.int32(0x7FFFFFFF)
_ROW = np.int64(0xFFFFFFFF)


def ranked(rows: NDArray[np.int64], products: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Both in the order of the products, best first.

    Args:
        rows: int64 [n], each less than 2^32, none twice, in any order.
        products: float32 [n], no NaN among them.
    """
    keys = np.empty(len(rows), np.int64)
    _join(rows, products.view(np.int32), keys)
    keys.sort()
    ordered, found = np.empty_like(rows), np.empty(len(rows), np.int32)
    _part(keys, ordered, found)
    return ordered, found.view(np.float32)


@numba.njit(cache=True, nogil=True)
def _join(rows, bits, keys):  # type: ignore[no-untyped-def]
    for position in range(len(rows)):
        value = bits[position]
        if not value & _ALL_BUT_SIGN:
            value = np.int32(0)  # both zeros are one value
        descending = ~(value ^ ((value >> 31) & _ALL_BUT_SIGN))
        keys[position] = np.int64(descending) << 32 | rows[position]


@numba.njit(cache=True, nogil=True)
def _part(keys, rows, bits):  # type: ignore[no-untyped-def]
    for position in range(len(keys)):
        rows[position] = keys[position] & _ROW
        value = np.int32(~(keys[position] >> 32))
        bits[position] = value ^ ((value >> 31) & _ALL_BUT_SIGN)
