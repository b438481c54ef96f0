"""The compiled search for the strongest regions of a layer, and the sums over their boxes (thesis, equations 3.1–3.4).

``core.method.equations`` says what is computed.  The activations are channels last, as the network leaves them, and
are read in that order.  A cell joins the regions of its earlier neighbours (to the left and in the row above), so that
boxes and sums are complete after the last cell.
"""

from __future__ import annotations

import numba
import numpy as np

from core.kernels.projections import finish_row, squared_length


@numba.njit(cache=True, nogil=True)
def _first(parents, region):  # type: ignore[no-untyped-def]
    """The region that a region was merged into."""
    while parents[region] != region:
        parents[region] = parents[parents[region]]
        region = parents[region]
    return region


@numba.njit(cache=True, nogil=True)
def _merge(into, other, parents, boxes, sizes, totals):  # type: ignore[no-untyped-def]
    parents[other] = into
    sizes[into] += sizes[other]
    totals[into] += totals[other]
    for side in range(2):
        boxes[into, side] = min(boxes[into, side], boxes[other, side])
        boxes[into, 2 + side] = max(boxes[into, 2 + side], boxes[other, 2 + side])


@numba.njit(cache=True, nogil=True)
def _label(activations, levels, numbers, parents, channels, boxes, sizes, totals):  # type: ignore[no-untyped-def]
    """Put all cells of level 1 and above into regions; return how many were begun, those merged since included."""
    height, width, count = activations.shape
    found = 0
    for y in range(height):
        for x in range(width):
            # Levels and numbers have a border above, to the left and to the right.
            here, before = levels[y + 1, x + 1], levels[y + 1, x]
            above = levels[y, x], levels[y, x + 1], levels[y, x + 2]
            for k in range(count):
                level = here[k]
                if level < 1:
                    continue
                region = -1
                if before[k] == level:
                    region = _first(parents, numbers[y + 1, x, k])
                for aside in range(3):
                    if above[aside][k] == level:
                        other = _first(parents, numbers[y, x + aside, k])
                        if region < 0:
                            region = other
                        elif other != region:
                            _merge(min(region, other), max(region, other), parents, boxes, sizes, totals)
                            region = min(region, other)
                if region < 0:
                    region = found
                    found += 1
                    parents[region], channels[region], sizes[region], totals[region] = region, k, 0, 0
                    boxes[region, 0], boxes[region, 1], boxes[region, 2], boxes[region, 3] = y, x, y + 1, x + 1
                numbers[y + 1, x + 1, k] = region
                sizes[region] += 1
                totals[region] += activations[y, x, k]
                boxes[region, 1] = min(boxes[region, 1], x)
                boxes[region, 2] = y + 1
                boxes[region, 3] = max(boxes[region, 3], x + 1)
    return found


@numba.njit(cache=True, nogil=True)
def strongest(activations, step, wanted):  # type: ignore[no-untyped-def]
    """Find the N regions of highest energy over all feature maps (equations 3.3 and 4.3).

    Args:
        activations: float32 [X, Y, K], finite, contiguous.
        step: float32, over 0.
        wanted: N.

    Returns:
        Of at most N regions, by falling energy and ties by first occurrence (map by map, then row by row):
        boxes, int32 [T, 4], top, left, bottom, right, half-open; energies, float32 [T], mean activations; channels,
        int32 [T].
    """
    height, width, count = activations.shape
    levels = np.empty((height + 1, width + 2, count), np.float32)
    levels[0], levels[:, 0], levels[:, width + 1] = 0, 0, 0
    most = 0
    for y in range(height):
        for x in range(width):
            here = levels[y + 1, x + 1]
            for k in range(count):
                here[k] = np.floor(activations[y, x, k] / step)
                most += here[k] >= 1
    numbers = np.empty((height + 1, width + 2, count), np.int32)
    parents, channels, sizes = np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most, np.int32)
    boxes, totals = np.empty((most, 4), np.int32), np.empty(most, np.float64)
    begun = _label(activations, levels, numbers, parents, channels, boxes, sizes, totals)
    retained = np.flatnonzero(parents[:begun] == np.arange(begun))
    energies = totals[retained] / sizes[retained]
    if len(retained) > wanted:  # only these are sorted
        strong = energies >= -np.partition(-energies, wanted - 1)[wanted - 1]
        retained, energies = retained[strong], energies[strong]
    order = np.argsort(channels[retained], kind="mergesort")
    order = order[np.argsort(-energies[order], kind="mergesort")][:wanted]
    retained, energies = retained[order], energies[order]
    return boxes[retained], energies.astype(np.float32), channels[retained]


@numba.njit(cache=True, nogil=True, inline="always")
def _add_up(activations, box, total):  # type: ignore[no-untyped-def]
    """Put the sum over one box of the first n values of each cell into ``total``, float32 [n]."""
    total[:] = 0
    for y in range(box[0], box[2]):
        for x in range(box[1], box[3]):
            cell = activations[y, x]
            for k in range(len(total)):
                total[k] += cell[k]


@numba.njit(cache=True, nogil=True)
def sums_within(activations, boxes, sums):  # type: ignore[no-untyped-def]
    """Put the sum of the local descriptors in each box into ``sums``.

    Args:
        activations: float32 [X, Y, K], contiguous.
        boxes: int32 [T, 4], top, left, bottom, right, half-open.
        sums: float32 [T, K], written.
    """
    for t in range(len(boxes)):
        _add_up(activations, boxes[t], sums[t])


@numba.njit(cache=True, nogil=True)
def projected_within(activations, products, boxes, shift, projected):  # type: ignore[no-untyped-def]
    """Put the projections of the sums into ``projected``.

    A projection needs the length of a sum f and its product f W, which is the sum of the cells' products.

    Args:
        products: of the cells with the projection's matrix W, float32 [X, Y, d], contiguous.
        shift: m W, float32 [d].
        projected: float32 [T, values], written; at most d values.
    """
    total, summed = np.empty(activations.shape[2], np.float32), np.empty(projected.shape[1], np.float32)
    for t in range(len(boxes)):
        _add_up(activations, boxes[t], total)
        _add_up(products, boxes[t], summed)
        finish_row(summed, squared_length(total), shift, projected[t])
