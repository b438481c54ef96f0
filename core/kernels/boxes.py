"""The compiled sums of local descriptors over the boxes of regions (thesis, equations 3.4 and 4.4), and projections.

``core.method.equations.regional_features`` says what is computed.  Most boxes are small and summed cell by cell.  If
the larger ones together hold many cells, a summed-area table is filled, which takes four look-ups for a box.
"""

from __future__ import annotations

import numba
import numpy as np

from core.kernels.projections import finish_row, squared_length

FEW = 16
"""Boxes of at most this many cells are summed in float32; the rounding of so few terms is negligible."""


@numba.njit(cache=True, nogil=True)
def _fill(activations, table):  # type: ignore[no-untyped-def]
    """Fill the summed-area table with the sums over all cells above and to the left; row and column 0 stay zero."""
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
    """Put the sum over a small box into ``total``, two cells at a time; float32 [X·Y, K] to [K]."""
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
    """Whether the larger boxes hold so many cells that a summed-area table saves time."""
    many = 0
    for t in range(len(boxes)):
        area = (boxes[t, 2] - boxes[t, 0]) * (boxes[t, 3] - boxes[t, 1])
        many += area if area > FEW else 0
    return many > 2 * cells


@numba.njit(cache=True, nogil=True, inline="always")
def _sum_within(cells, width, box, tabled, table, exact, total):  # type: ignore[no-untyped-def]
    """Put the sum over one box of the first n values of each cell into ``total``, float32 [n].

    Args:
        cells: float32 [X·Y, K].
        box: int32 [4].
        tabled: whether ``table`` holds the sums of these cells.
        exact: workspace, float64 [K].
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
        table: workspace, float64 [X + 1, Y + 1, K], with zeros in the first row and column.
        sums: float32 [T, K], written.
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
    """Put the projections of the sums into ``projected``.

    A projection needs the length of a sum f and its product f W, which is the sum of the cells' products.

    Args:
        products: of the cells with the projection's matrix W, float32 [X, Y, d], contiguous.
        products_table: workspace, float64 [X + 1, Y + 1, d], with zeros in the first row and column.
        shift: m W, float32 [d].
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
