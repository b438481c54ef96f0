"""The compiled search for the mutual nearest neighbours among the cells of one frame and of many others, within reach.

``core.method.agreement.correspondences`` says what is computed, and ``core.method.agreement.promise`` what of it is
computed for more frames.
"""

from __future__ import annotations

import numba
import numpy as np

NUMBER_BITS = 20
"""Bits of a key that hold the number of a cell; a product stands above them, so that the highest key has the highest
product and, of equal products, the lowest cell."""

LAST = (1 << NUMBER_BITS) - 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _product(a, b):  # type: ignore[no-untyped-def]
    """The inner product of int16 [L] and [L], each value from -128 to 127; int32, so that processors add pairs."""
    total = np.int32(0)
    for i in range(len(b)):
        total = np.int32(total + np.int32(np.int32(a[i]) * np.int32(b[i])))
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def squared_sums(query, references, columns, rows_apart, columns_apart, cosine):  # type: ignore[no-untyped-def]
    """Σ cos² over the mutual nearest neighbours of a query and each of k references; ties to the lower cell.

    Args:
        query: int8 [C, L]; C is a multiple of the columns and at most LAST.
        references: int8 [k, C, L].
        columns: of the grid.
        rows_apart, columns_apart: the reach.
        cosine: float32, by which an inner product is multiplied to become a cosine.

    Returns:
        float32 [k].
    """
    cells, length = query.shape
    rows = cells // columns
    wide, cell_values = query.astype(np.int16), np.empty(length, np.int16)
    products = np.empty(columns, np.int64)
    of_query, of_reference = np.empty(cells, np.int64), np.empty(cells, np.int64)  # the highest keys
    sums = np.empty(len(references), np.float32)
    for k in range(len(references)):
        of_query[:] = 0
        for cell in range(cells):
            row, column = cell // columns, cell % columns
            for i in range(length):
                cell_values[i] = references[k, cell, i]
            left, right = max(0, column - columns_apart), min(columns, column + columns_apart + 1)
            highest = 0
            for y in range(max(0, row - rows_apart), min(rows, row + rows_apart + 1)):
                start = y * columns + left
                for j in range(right - left):
                    products[j] = _product(wide[np.uint64(start + j)], cell_values)  # unsigned: never from the end
                for j in range(right - left):
                    key = products[j] << NUMBER_BITS
                    highest = max(highest, key | (LAST - start - j))
                    of_query[start + j] = max(of_query[start + j], key | (LAST - cell))
            of_reference[cell] = highest
        total = np.float32(0)
        for cell in range(cells):
            product = of_reference[cell] >> NUMBER_BITS
            found = LAST - (of_reference[cell] & LAST)
            if product > 0 and of_query[found] & LAST == LAST - cell:
                value = np.float32(product) * cosine
                total += value * value
        sums[k] = total
    return sums


SPACING = 3
"""Of the cells of a reference those in every third row and column are a sample."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sampled_squares(query, references, columns, rows_apart, columns_apart, cosine):  # type: ignore[no-untyped-def]
    """Mean of cos² of the query's best cell for each cell of a sample of each of k references, where that is over 0.

    Args:
        query: int8 [C, L]; C is a multiple of the columns.
        references: int8 [k, C, L].
        columns: of the grid.
        rows_apart, columns_apart: the reach.
        cosine: float32, by which an inner product is multiplied to become a cosine.

    Returns:
        float32 [k].
    """
    cells, length = query.shape
    rows = cells // columns
    wide, cell_values = query.astype(np.int16), np.empty(length, np.int16)
    means = np.empty(len(references), np.float32)
    for k in range(len(references)):
        total, sample = np.float32(0), 0
        for row in range(0, rows, SPACING):
            for column in range(0, columns, SPACING):
                for i in range(length):
                    cell_values[i] = references[k, row * columns + column, i]
                left, right = max(0, column - columns_apart), min(columns, column + columns_apart + 1)
                highest = np.int64(0)
                for y in range(max(0, row - rows_apart), min(rows, row + rows_apart + 1)):
                    start = y * columns + left
                    for j in range(right - left):
                        product = np.int64(_product(wide[np.uint64(start + j)], cell_values))
                        if product > highest:
                            highest = product
                value = np.float32(highest) * cosine
                total += value * value
                sample += 1
        means[k] = total / np.float32(max(1, sample))
    return means
