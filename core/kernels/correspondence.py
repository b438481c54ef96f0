"""The compiled search for the mutual nearest neighbours among the cells of one frame and of many others, within reach.

``core.method.agreement.correspondences`` says what is computed.  The rows of a reference are compared one after
another with the rows of the query within reach.  The best match of a reference cell is known when its row is done; the
best match of a query cell is the best of all rows.
"""

from __future__ import annotations

import numba
import numpy as np

from core.kernels.cell_blocks import (
    CELLS,
    FEWER_CELLS,
    HELD,
    HIGHEST,
    LANES,
    LOWEST,
    MOVED,
    byte_at,
    fewer_cells,
    highest,
    is_wide,
    one_row,
    one_with_one,
    three_rows,
    two_rows,
    values_a_word,
)

WHOLE_WORDS = 4
"""The number of values of a cell must be a multiple of this."""


@numba.njit(cache=True, nogil=True)
def _words_of(query, columns):  # type: ignore[no-untyped-def]
    """The query's rows as vectors, int32 [rows, parts, words, LANES]: each part has HELD cells of a row and a zero."""
    cells, length = query.shape
    values = values_a_word()
    zero = np.int32(MOVED if values == 4 else 0)
    words = np.full((cells // columns, -(-columns // HELD), length // values, LANES), zero, np.int32)
    for cell in range(cells):
        y, x = cell // columns, cell % columns
        for step in range(length // values):
            word = np.int32(query[cell, step])
            if values == 2:
                word = (np.int32(query[cell, 2 * step]) & 0xFFFF) | (np.int32(query[cell, 2 * step + 1]) << 16)
            elif values == 4:
                word = zero
                for i in range(4):
                    word ^= (np.int32(query[cell, 4 * step + i]) & 0xFF) << (8 * i)
            words[y, x // HELD, step, x % HELD] = word
    return words


@numba.njit(cache=True, nogil=True)
def _limits_of(columns, apart):  # type: ignore[no-untyped-def]
    """Which lanes are within reach of each column: HIGHEST, else LOWEST; int32 [parts, columns, LANES]."""
    limits = np.full((-(-columns // HELD), columns, LANES), LOWEST, np.int32)
    for u in range(columns):
        for x in range(max(0, u - apart), min(columns, u + apart + 1)):
            limits[x // HELD, u, x % HELD] = HIGHEST
    return limits


@numba.njit(cache=True, nogil=True)
def _words_given(address, width, words):  # type: ignore[no-untyped-def]
    """The address of a reference row's words; unless a word is four bytes as they lie, it is put into ``words``."""
    values = values_a_word()
    if values == 4:
        return address
    if values == 2:
        halves = words.view(np.int16)
        for i in range(width):
            halves[i] = byte_at(address + i)
    else:
        for i in range(width):
            words[i] = byte_at(address + i)
    return np.int64(words.ctypes.data)


@numba.njit(cache=True, nogil=True)
def _compare(held, limits, part, given, row, low, high, there, back):  # type: ignore[no-untyped-def]
    """Compare one row of a reference with one part of the query's rows low … high, and update there and back."""
    columns, steps = limits.shape[1], held.shape[2]
    stride = steps * 4
    size = CELLS if is_wide() else FEWER_CELLS
    if columns < size:
        size = 1
    u = 0
    while u < columns:
        u = min(u, columns - size)  # the last group overlaps the one before it
        y = low
        while y < high:
            place = (
                held[y, part].ctypes.data,
                held.strides[0],
                given + u * stride,
                stride,
                steps,
                limits[part, u].ctypes.data,
                there[y, part].ctypes.data,
                there.strides[0],
                back[u].ctypes.data,
                row * columns + u,
                y * columns + part * HELD,
                columns,
            )
            left = high - y
            if size == 1:
                one_with_one(place)
                y += 1
            elif not is_wide():
                fewer_cells(place)
                y += 1
            elif left == 2 or left == 4:
                two_rows(place)
                y += 2
            elif left > 2:
                three_rows(place)
                y += 3
            else:
                one_row(place)
                y += 1
        u += size


@numba.njit(cache=True, nogil=True)
def _keep_backs(back, part, highs, backs):  # type: ignore[no-untyped-def]
    """Update the best query cell of each cell of a reference's row with those of one part; ties to the lower cell."""
    for u in range(len(back)):
        product, cell = highest(back[u].ctypes.data)
        if part == 0 or product > highs[u] or (product == highs[u] and cell < backs[u]):
            highs[u], backs[u] = product, cell


@numba.njit(cache=True, nogil=True)
def _sum_of(there, backs, columns, cosine):  # type: ignore[no-untyped-def]
    """Σ cos² over the cells of a reference that are the best matches of their best matches."""
    total = np.zeros(1, np.float32)
    for cell in range(len(backs)):
        y, x = backs[cell] // columns, backs[cell] % columns
        product = there[y, x // HELD, 0, x % HELD]
        if product > 0 and there[y, x // HELD, 1, x % HELD] == cell:
            value = np.float32(product) * cosine
            total[0] += value * value
    return total[0]


@numba.njit(cache=True, nogil=True)
def squared_sums(query, addresses, columns, rows_apart, columns_apart, cosine):  # type: ignore[no-untyped-def]
    """Σ cos² over the mutual nearest neighbours of a query and each of k references; ties to the lower cell.

    Args:
        query: int8 [C, L]; C is a multiple of the columns, L of WHOLE_WORDS.
        addresses: int64 [k], of the first values of the references, int8 [C, L] each.
        rows_apart, columns_apart: the reach.
        cosine: float32, by which an inner product is multiplied to become a cosine.

    Returns:
        float32 [k].
    """
    cells, length = query.shape
    rows, width = cells // columns, columns * length
    held, limits = _words_of(query, columns), _limits_of(columns, columns_apart)
    parts = held.shape[1]
    words = np.empty(width // values_a_word(), np.int32)
    there, back = np.empty((rows, parts, 2, LANES), np.int32), np.empty((columns, 2, LANES), np.int32)
    highs, backs = np.empty(columns, np.int32), np.empty(cells, np.int32)
    sums = np.empty(len(addresses), np.float32)
    for k in range(len(addresses)):
        there[:] = LOWEST
        for row in range(rows):
            given = _words_given(addresses[k] + row * width, width, words)
            low, high = max(0, row - rows_apart), min(rows, row + rows_apart + 1)
            for part in range(parts):
                back[:] = LOWEST
                _compare(held, limits, part, given, row, low, high, there, back)
                _keep_backs(back, part, highs, backs[row * columns : (row + 1) * columns])
        sums[k] = _sum_of(there, backs, columns, cosine)
    return sums
