"""The compiled search for the strongest regions of a layer (thesis, equations 3.1–3.3 and 4.1–4.3).

``core.method.equations`` says what is computed.  The activations are channels last, as the network leaves them, and
are read once in that order.  One bit a cell says whether it is above the background, so that cells without neighbours
(most of them) are skipped 64 channels at a time.  A cell joins the regions of its earlier neighbours (to the left and
in the row above), so that boxes and sums are complete after the last cell.  Only cells at or above the level that
holds enough regions are labelled: the mean of a region lies within its level, so that no region below can be among
the strongest.

At the end stand the sums of local descriptors over the regions' boxes (equations 3.4 and 4.4).  Small boxes are summed
directly; when the others hold more cells together than a summed-area table has, the table is filled, and each box is
four look-ups.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from core.kernels.projections import finish_row, squared_length

ir: Any = cgutils.ir  # type: ignore[attr-defined]  # the LLVM that numba itself compiles with

BLOCK = 64
"""Values of a block, one bit each."""


def _reaching(typingctx: Any, values: Any, start: Any, threshold: Any) -> Any:
    """Bit i is whether ``values[start + i] >= threshold``, for i from 0 to 63, all within the array.

    ``values`` is float32 [n], contiguous; ``start`` int64; ``threshold`` float32; the result uint64.
    """
    signature = types.uint64(values, types.int64, types.float32)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        block, many = ir.VectorType(ir.FloatType(), BLOCK), ir.VectorType(ir.IntType(32), BLOCK)
        pointer = builder.bitcast(builder.gep(array.data, [arguments[1]]), block.as_pointer())
        seen = builder.load(pointer)
        seen.align = 4
        nothing = ir.Constant(block, ir.Undefined)
        one = builder.insert_element(nothing, arguments[2], ir.Constant(ir.IntType(32), 0))
        limit = builder.shuffle_vector(one, nothing, ir.Constant(many, [0] * BLOCK))
        return builder.bitcast(builder.fcmp_ordered(">=", seen, limit), ir.IntType(BLOCK))

    return signature, generate


reaching: Any = intrinsic(_reaching)


def _lowest_bit(typingctx: Any, bits: Any) -> Any:
    """The position of the lowest bit that is set; uint64, not 0, to uint64."""
    signature = types.uint64(types.uint64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return signature, generate


lowest_bit: Any = intrinsic(_lowest_bit)


def _set_bits(typingctx: Any, bits: Any) -> Any:
    """The number of bits that are set; uint64 to uint64."""
    signature = types.uint64(types.uint64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return signature, generate


set_bits: Any = intrinsic(_set_bits)


HISTOGRAM_BINS = 1024
"""Levels of the histogram by which cells are left out; all higher levels share its last bin."""

FIRST_GUESS = 2
"""Cells per wanted region in the first attempt to label few enough cells."""

KEYS = 2048
"""Buckets of the first, coarse sort of the regions."""

SHORT_RUN = 32
"""Buckets of at most this many regions are sorted by insertion, larger ones by merge sort."""

# The rows of the workspace: values of each cell above the background, and of the region that begins with it.
CHANNEL, PARENT, SIZE, TOP, LEFT, BOTTOM, RIGHT, ORDER, SPARE, KEY = range(10)
INTEGERS = 10
"""Rows of int32 in the workspace of :func:`strongest`, one column a cell."""
VALUE, LEVEL = range(2)
SINGLES = 2
"""Rows of float32 in its workspace."""
TOTAL, ENERGY = range(2)
DOUBLES = 2
"""Rows of float64 in its workspace."""


def bits_shape(height: int, width: int, channels: int) -> tuple[int, int]:
    """The shape of a layer's bits: cells, with a border above, to the left and to the right, by blocks of channels."""
    return (height + 1) * (width + 2), -(-channels // BLOCK)


@numba.njit(cache=True, nogil=True)
def _foreground(activations, step, cells, singles, bits, firsts):  # type: ignore[no-untyped-def]
    """Collect the cells of level 1 and above, row by row and within a cell by channel; return how many there are.

    ``bits`` becomes 1 at those cells; ``firsts`` becomes the number of the first collected cell of each block.
    """
    height, width, channels = activations.shape
    found = 0
    for y in range(height):
        for x in range(width):
            values, at = activations[y, x], (y + 1) * (width + 2) + x + 1
            for block in range(bits.shape[1]):
                start = block * BLOCK
                if start + BLOCK <= channels:
                    reached = reaching(values, start, step)
                else:
                    reached = np.uint64(0)
                    for k in range(start, channels):
                        reached |= np.uint64(values[k] >= step) << np.uint64(k - start)
                bits[at, block], firsts[at, block] = reached, found
                while reached != 0:
                    k = start + int(lowest_bit(reached))
                    cells[CHANNEL, found], cells[TOP, found], cells[LEFT, found] = k, y, x
                    singles[VALUE, found] = values[k]
                    found += 1
                    reached &= reached - np.uint64(1)
    for i in range(found):
        singles[LEVEL, i] = np.floor(singles[VALUE, i] / step)
    return found


@numba.njit(cache=True, nogil=True)
def _keep_from(lowest, cells, singles, bits, firsts):  # type: ignore[no-untyped-def]
    """Keep only the collected cells of level >= ``lowest``; return how many there are."""
    i, found = 0, 0
    for at in range(bits.shape[0]):
        for block in range(bits.shape[1]):
            reached = bits[at, block]
            firsts[at, block] = found
            while reached != 0:
                if singles[LEVEL, i] >= lowest:
                    for row in (CHANNEL, TOP, LEFT):
                        cells[row, found] = cells[row, i]
                    singles[VALUE, found], singles[LEVEL, found] = singles[VALUE, i], singles[LEVEL, i]
                    found += 1
                else:
                    bits[at, block] ^= reached & ~(reached - np.uint64(1))
                i += 1
                reached &= reached - np.uint64(1)
    return found


@numba.njit(cache=True, nogil=True)
def _level_with(levels, wanted):  # type: ignore[no-untyped-def]
    """The highest level >= 1 at or above which at least ``wanted`` of the cells lie (1 if there are fewer)."""
    if len(levels) < wanted:
        return np.float32(1)
    histogram = np.zeros(HISTOGRAM_BINS, np.int32)
    highest = 1
    for i in range(len(levels)):
        level = int(min(levels[i], np.float32(HISTOGRAM_BINS - 1)))
        histogram[level] += 1
        highest = max(highest, level)
    seen, level = 0, highest + 1
    while level > 1 and seen < wanted:
        level -= 1
        seen += histogram[level]
    return np.float32(level)


@numba.njit(cache=True, nogil=True)
def _first(parents, i):  # type: ignore[no-untyped-def]
    """The first cell of the region that cell i belongs to."""
    while parents[i] != i:
        parents[i] = parents[parents[i]]
        i = parents[i]
    return i


@numba.njit(cache=True, nogil=True)
def _merge(cells, totals, into, other):  # type: ignore[no-untyped-def]
    """Make two regions one, which begins with cell ``into``."""
    cells[PARENT, other] = into
    totals[into] += totals[other]
    cells[SIZE, into] += cells[SIZE, other]
    cells[TOP, into] = min(cells[TOP, into], cells[TOP, other])
    cells[LEFT, into] = min(cells[LEFT, into], cells[LEFT, other])
    cells[BOTTOM, into] = max(cells[BOTTOM, into], cells[BOTTOM, other])
    cells[RIGHT, into] = max(cells[RIGHT, into], cells[RIGHT, other])


@numba.njit(cache=True, nogil=True)
def _label(count, shape, cells, singles, totals, bits, firsts):  # type: ignore[no-untyped-def]
    """Join the collected cells to regions; return how many regions there are."""
    height, width = shape
    parents, levels = cells[PARENT], singles[LEVEL]
    for i in range(count):  # at first each cell is a region
        parents[i], cells[SIZE, i], totals[i] = i, 1, singles[VALUE, i]
        cells[BOTTOM, i], cells[RIGHT, i] = cells[TOP, i] + 1, cells[LEFT, i] + 1
    regions = count
    for y in range(height):
        for x in range(width):
            at = (y + 1) * (width + 2) + x + 1
            over = at - width - 2
            neighbours = (at - 1, over - 1, over, over + 1)
            for block in range(bits.shape[1]):
                here = bits[at, block]
                there = bits[at - 1, block] | bits[over - 1, block] | bits[over, block] | bits[over + 1, block]
                touching = here & there
                while touching != 0:
                    below = (touching & ~(touching - np.uint64(1))) - np.uint64(1)
                    i = firsts[at, block] + int(set_bits(here & below))
                    region = i
                    for place in neighbours:
                        if bits[place, block] & (below + np.uint64(1)):
                            j = firsts[place, block] + int(set_bits(bits[place, block] & below))
                            if levels[j] == levels[i]:
                                other = _first(parents, j)
                                if other != region:
                                    _merge(cells, totals, min(region, other), max(region, other))
                                    region = min(region, other)
                                    regions -= 1
                    touching &= touching - np.uint64(1)
    return regions


@numba.njit(cache=True, nogil=True)
def _before(a, b, energies, channels):  # type: ignore[no-untyped-def]
    """Whether the region that begins with cell a comes before that of cell b."""
    if energies[a] != energies[b]:
        return energies[a] > energies[b]
    return channels[a] < channels[b] if channels[a] != channels[b] else a < b


@numba.njit(cache=True, nogil=True)
def _settle(run, energies, channels):  # type: ignore[no-untyped-def]
    """Sort the regions of one bucket."""
    if len(run) > SHORT_RUN:
        run.sort()  # by their first cells
        run[:] = run[np.argsort(channels[run], kind="mergesort")]
        run[:] = run[np.argsort(-energies[run], kind="mergesort")]
        return
    for i in range(1, len(run)):
        moved, place = run[i], i
        while place > 0 and _before(moved, run[place - 1], energies, channels):
            run[place] = run[place - 1]
            place -= 1
        run[place] = moved


@numba.njit(cache=True, nogil=True)
def _sorted(count, wanted, cells, doubles):  # type: ignore[no-untyped-def]
    """The first cells of the ``wanted`` regions of highest energy, ties by channel, then by the first cell.

    The regions are first sorted into buckets by a coarse key; then the buckets that matter are sorted one by one.
    """
    energies, keys, channels = doubles[ENERGY], cells[KEY], cells[CHANNEL]
    found, least, most = 0, np.inf, 0.0
    for i in range(count):
        if cells[PARENT, i] == i:
            energy = doubles[TOTAL, i] / cells[SIZE, i]
            energies[i] = energy
            least, most = min(least, energy), max(most, energy)
            cells[SPARE, found] = i
            found += 1
    scale = (KEYS - 1) / (most - least) if most > least else 0.0
    ends = np.zeros(KEYS, np.int32)
    for t in range(found):  # a higher energy never has a higher key
        i = cells[SPARE, t]
        keys[i] = np.int32(min(KEYS - 1.0, (most - energies[i]) * scale))
        ends[keys[i]] += 1
    for key in range(1, KEYS):
        ends[key] += ends[key - 1]
    for t in range(found - 1, -1, -1):  # backwards, so that the ends of the buckets become their starts
        i = cells[SPARE, t]
        ends[keys[i]] -= 1
        cells[ORDER, ends[keys[i]]] = i
    starts = ends
    for key in range(KEYS):
        stop = starts[key + 1] if key + 1 < KEYS else found
        if stop - starts[key] > 1:
            _settle(cells[ORDER, starts[key] : stop], energies, channels)
        if stop >= wanted:
            break
    return cells[ORDER, : min(found, wanted)]


@numba.njit(cache=True, nogil=True)
def strongest(  # type: ignore[no-untyped-def]
    activations, step, cells, singles, doubles, bits, firsts, boxes, energies, channels
):
    """Find the N regions of highest energy over all feature maps (equations 3.3 and 4.3).

    Args:
        activations: float32 [X, Y, K], finite, contiguous.
        step: float32, over 0.
        cells, singles, doubles: workspace of INTEGERS, SINGLES and DOUBLES rows and X·Y·K columns.
        bits, firsts: workspace, uint64 and int32 of ``bits_shape``, with zeros in the border of ``bits``.
        boxes: int32 [N, 4], written: top, left, bottom, right, half-open.
        energies: float32 [N], written: mean activations.
        channels: int32 [N], written: feature maps.

    Returns:
        How many regions there are, at most N, by falling energy; ties by first occurrence (map by map, then row by
        row).
    """
    wanted = len(energies)
    guess = FIRST_GUESS * wanted
    while True:
        count = _foreground(activations, step, cells, singles, bits, firsts)
        lowest = _level_with(singles[LEVEL, :count], guess)
        if lowest > 1:
            count = _keep_from(lowest, cells, singles, bits, firsts)
        regions = _label(count, activations.shape[:2], cells, singles, doubles[TOTAL], bits, firsts)
        if regions >= wanted or lowest == 1:
            break
        guess *= 2
    order = _sorted(count, wanted, cells, doubles)
    for t in range(len(order)):
        i = order[t]
        boxes[t, 0], boxes[t, 1] = cells[TOP, i], cells[LEFT, i]
        boxes[t, 2], boxes[t, 3] = cells[BOTTOM, i], cells[RIGHT, i]
        energies[t] = doubles[ENERGY, i]
        channels[t] = cells[CHANNEL, i]
    return len(order)


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
