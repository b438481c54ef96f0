"""What lies in the boxes of regions (thesis, equation 3.4), compiled: sums of local descriptors, and their projections.

Most boxes are small and summed directly.  When the others hold more cells together than a summed-area table has, it is
filled, and each is four look-ups.
"""

from __future__ import annotations

import numba
import numpy as np

from core.kernels.projections import finish_row, squared_length

FEW = 16
"""Cells of a box that are summed as they are; the rounding of so few is far under that of a feature's length."""


@numba.njit(cache=True, nogil=True)
def _fill(activations, table):  # type: ignore[no-untyped-def]
    """The summed-area table: sums over all cells above and to the left; its first row and column stay zero."""
    height, width, channels = activations.shape
    row = np.empty(channels, np.float64)
    for y in range(height):
        row[:] = 0
        for x in range(width):
            for k in range(channels):
                row[k] += activations[y, x, k]
                table[y + 1, x + 1, k] = table[y, x + 1, k] + row[k]


@numba.njit(cache=True, nogil=True, inline="always")
def _add_few(cells, top, left, bottom, right, width, total):  # type: ignore[no-untyped-def]
    """The sum over a small box, two cells at a time; float32 [X·Y, K] to [K]."""
    for y in range(top, bottom):
        at, stop = y * width + left, y * width + right
        if y == top and stop - at == 1:
            one = cells[at]
            for k in range(len(total)):
                total[k] = one[k]
            at += 1
        elif y == top:
            one, two = cells[at], cells[at + 1]
            for k in range(len(total)):
                total[k] = one[k] + two[k]
            at += 2
        while at + 1 < stop:
            one, two = cells[at], cells[at + 1]
            for k in range(len(total)):
                total[k] += one[k] + two[k]
            at += 2
        if at < stop:
            one = cells[at]
            for k in range(len(total)):
                total[k] += one[k]


@numba.njit(cache=True, nogil=True)
def _is_tabled(boxes, cells):  # type: ignore[no-untyped-def]
    """Whether the larger boxes hold so many cells that a table pays."""
    many = 0
    for t in range(len(boxes)):
        area = (boxes[t, 2] - boxes[t, 0]) * (boxes[t, 3] - boxes[t, 1])
        many += area if area > FEW else 0
    return many > 2 * cells


@numba.njit(cache=True, nogil=True, inline="always")
def _sum_within(cells, width, box, tabled, table, exact, total):  # type: ignore[no-untyped-def]
    """The sum over one box into ``total``, float32 [n], of the first n values of each cell.

    ``cells``: float32 [X·Y, K]; ``box``: int32 [4]; ``table``: of these cells, if ``tabled``; ``exact``: room for
    float64 [K].
    """
    top, left, bottom, right = box[0], box[1], box[2], box[3]
    if (bottom - top) * (right - left) <= FEW:
        _add_few(cells, top, left, bottom, right, width, total)
    elif tabled:
        for k in range(len(total)):
            total[k] = table[bottom, right, k] - table[top, right, k] - table[bottom, left, k] + table[top, left, k]
    else:
        exact[:] = 0
        for y in range(top, bottom):
            for at in range(y * width + left, y * width + right):
                for k in range(len(total)):
                    exact[k] += cells[at, k]
        for k in range(len(total)):
            total[k] = exact[k]


@numba.njit(cache=True, nogil=True)
def sums_within(activations, boxes, table, sums):  # type: ignore[no-untyped-def]
    """Put the sum of the local descriptors in each box into ``sums``.

    Args:
        activations: float32 [X, Y, K], contiguous.
        boxes: int32 [T, 4], top, left, bottom, right, half-open.
        table: room for float64 [X + 1, Y + 1, K], the first row and column 0.
        sums: float32 [T, K].
    """
    height, width, channels = activations.shape
    cells, exact = activations.reshape(height * width, channels), np.empty(channels, np.float64)
    tabled = _is_tabled(boxes, height * width)
    if tabled:
        _fill(activations, table)
    for t in range(len(boxes)):
        _sum_within(cells, width, boxes[t], tabled, table, exact, sums[t])


@numba.njit(cache=True, nogil=True)
def projected_within(  # type: ignore[no-untyped-def]
    activations, products, boxes, table, products_table, shift, projected
):
    """The same, projected: of the sums only their length is used, and the projection's products, summed alike.

    Args:
        products: float32 [X, Y, d], contiguous.
        products_table: room for float64 [X + 1, Y + 1, d].
        shift: float32 [d].
        projected: float32 [T, values], written; at most d values.
    """
    height, width, channels = activations.shape
    cells = activations.reshape(height * width, channels)
    multiplied = products.reshape(height * width, products.shape[2])
    exact, total = np.empty(channels, np.float64), np.empty(channels, np.float32)
    products_exact, summed = np.empty(products.shape[2], np.float64), np.empty(projected.shape[1], np.float32)
    tabled = _is_tabled(boxes, height * width)
    if tabled:
        _fill(activations, table)
        _fill(products, products_table)
    for t in range(len(boxes)):
        _sum_within(cells, width, boxes[t], tabled, table, exact, total)
        _sum_within(multiplied, width, boxes[t], tabled, products_table, products_exact, summed)
        finish_row(summed, squared_length(total), shift, projected[t])
