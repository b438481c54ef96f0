"""The compiled search for the best path through the pairs of two traverses' frames.

``core.judgement.alignment.best_path_by_rows`` says what is computed.
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def best_path(columns, gains, free, others, ordinary, uneven, begins):  # type: ignore[no-untyped-def]
    """The path with the largest sum of gains.

    Args:
        columns: int64 [Q, K], ascending in each row.
        gains: float64 [Q, K].
        free: bool [Q].
        others: the number of columns.
        ordinary: the loss of a pair that is not listed.
        uneven: float64 [S + 1], the cost of a step by 0 to S columns.
        begins: the step of a path's first pair, below 0.

    Returns:
        int64 [n, 2] of row and column, and the sum.
    """
    rows, listed = columns.shape
    steps = len(uneven)
    starts = np.zeros(rows + 1, np.int64)
    reached, came = np.empty(4 * listed + 16, np.int64), np.empty(4 * listed + 16, np.int8)
    totals, before = np.empty(others, np.float64), np.empty(others, np.float64)
    at = np.empty(steps, np.int64)
    best, end_row, end_column = 0.0, -1, -1
    count, low, high = 0, 0, 0  # of all rows; the columns that the row before reached are from low to high
    for row in range(rows):
        starts[row] = count
        if count + others > len(reached):
            room = 2 * len(reached) + others
            wider, wider_came = np.empty(room, np.int64), np.empty(room, np.int8)
            for i in range(count):
                wider[i], wider_came[i] = reached[i], came[i]
            reached, came = wider, wider_came
        if free[row]:
            own = 0
            for step in range(steps):
                at[step] = low
            while True:
                column = others
                if own < listed:
                    column = min(column, columns[row, own])
                for step in range(steps):
                    if at[step] < high:
                        column = min(column, reached[at[step]] + step)
                if column >= others:
                    break
                total, by, gain = -1.0, begins, -ordinary
                if own < listed and columns[row, own] == column:
                    total, gain = 0.0, gains[row, own]
                    own += 1
                for step in range(steps):
                    if at[step] < high and reached[at[step]] + step == column:
                        found = before[at[step] - low] - uneven[step]
                        if found >= 0 and found > total:
                            total, by = found, step
                        at[step] += 1
                if total >= 0 and total + gain > 0:
                    total += gain
                    reached[count], came[count], totals[count - starts[row]] = column, by, total
                    count += 1
                    if total > best:
                        best, end_row, end_column = total, row, column
        low, high = starts[row], count
        totals, before = before, totals
    starts[rows] = count
    first, path = rows, np.empty((rows, 2), np.int64)
    row, column = end_row, end_column
    while row >= 0:
        first -= 1
        path[first, 0], path[first, 1] = row, column
        place = starts[row]
        while reached[place] < column:
            place += 1
        if came[place] == begins:
            break
        row, column = row - 1, column - came[place]
    return path[first:], best
