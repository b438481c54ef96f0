"""The compiled loops of beliefs over places: how a motion moves one, and which places are one.

The motions (``along_sequence``, ``within_reach``, ``by_odometry``) take masses float32 [n] and multiply them by a
transition matrix, which ``core.belief.motion`` writes out in plain NumPy.  Forwards, the mass of a place is divided
among its successors; one of at most ``least`` is not moved but added to the first result, and what fits no successor
is added to the second.  With ``back`` the matrix is transposed, as smoothing needs it: a place gets the mean of what
its successors hold, or ``outside`` if it has none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import numba
import numpy as np

from core.places import METRIC, NO_LEVEL, NO_POSE

MISFIT = 12.0
"""A place with at least this misfit to a motion (five standard deviations) is no successor."""

FITS = math.exp(-2.0)
"""Weight of a place that fits a motion well enough: two standard deviations off."""


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    return cast(Callable[..., Any], numba.njit(cache=True, nogil=True)(function))


@_compiled
def _settle(p, i, targets, begin, count, weights, total, back, outside, moved):  # type: ignore[no-untyped-def]
    """Divide the mass of one place among its successors by their weights, or gather theirs; return what fits none."""
    scale = max(total, FITS)
    if back:
        gathered = outside * (scale - total)
        for e in range(count):
            gathered += weights[e] * p[targets[begin + e]]
        moved[i] += gathered / scale
        return 0.0
    share = p[i] / scale
    for e in range(count):
        moved[targets[begin + e]] += share * weights[e]
    return share * (scale - total)


@_compiled
def along_sequence(p, moving, first, last, offsets, weights, least, back, moved):  # type: ignore[no-untyped-def]
    """Along the sequences, only places in ``moving``; at the end of a sequence by what is left of the kernel."""
    negligible, gone = 0.0, 0.0
    for i in range(len(p)):
        if not moving[i]:
            continue
        if not back and p[i] <= least:
            negligible += p[i]
            continue
        low, high, total = len(offsets), 0, 0.0
        for k in range(len(offsets)):
            if first[i] <= i + offsets[k] < last[i]:
                low, high, total = min(low, k), k + 1, total + weights[k]
        if total == 0.0:  # a sequence shorter than the stride
            moved[i] += p[i]
        elif back:
            for k in range(low, high):
                moved[i] += p[i + offsets[k]] * weights[k] / total
        else:
            for k in range(low, high):
                moved[i + offsets[k]] += p[i] * weights[k] / total
    return negligible, gone


@_compiled
def _displacement(coordinates, i, j, half_turn, shrink):  # type: ignore[no-untyped-def]
    """From place i to place j in metres, the shorter way round the globe."""
    dx = coordinates[j, 0] - coordinates[i, 0]
    if abs(dx) > half_turn:
        dx -= math.copysign(2 * half_turn, dx)
    return dx * shrink, coordinates[j, 1] - coordinates[i, 1], coordinates[j, 2] - coordinates[i, 2]


@_compiled
def within_reach(  # type: ignore[no-untyped-def]
    p, starts, targets, coordinates, shrink, half_turn, reach, softness, least, back, outside, moved
):
    """To the joined places within ``reach`` alike, and a little to those just beyond it."""
    negligible, gone = 0.0, 0.0
    weights = np.empty(1 + np.max(starts[1:] - starts[:-1]), np.float64)
    for i in range(len(p)):
        begin, count = starts[i], starts[i + 1] - starts[i]
        if count == 0:
            continue
        if not back and p[i] <= least:
            negligible += p[i]
            continue
        total = 0.0
        for e in range(count):
            j = targets[begin + e]
            dx, dy, dz = _displacement(coordinates, i, j, half_turn, shrink[i])
            beyond = (math.sqrt(dx * dx + dy * dy + dz * dz) - reach) / softness
            weights[e] = 1.0
            if beyond > 0:
                weights[e] = math.exp(-0.5 * beyond * beyond) if beyond < 4 else 0.0
            total += weights[e]
        gone += _settle(p, i, targets, begin, count, weights, total, back, outside, moved)
    return negligible, gone


@_compiled
def by_odometry(  # type: ignore[no-untyped-def]
    p, starts, targets, coordinates, shrink, half_turn, heading, motion, least, back, outside, moved
):
    """To the joined places by how well each fits ``motion``: forward, left, turn, and two precisions."""
    negligible, gone = 0.0, 0.0
    forward, left, turn, precision, turn_precision = motion
    weights = np.empty(1 + np.max(starts[1:] - starts[:-1]), np.float64)
    distance = math.sqrt(forward * forward + left * left)
    for i in range(len(p)):
        begin, count = starts[i], starts[i + 1] - starts[i]
        if count == 0:
            continue
        if not back and p[i] <= least:
            negligible += p[i]
            continue
        known = not math.isnan(heading[i])
        cos, sin = 1.0, 0.0
        if known:
            cos, sin = math.cos(heading[i]), math.sin(heading[i])
        east, north = forward * cos - left * sin, forward * sin + left * cos
        total = 0.0
        for e in range(count):
            j = targets[begin + e]
            dx, dy, dz = _displacement(coordinates, i, j, half_turn, shrink[i])
            if known:
                off = (dx - east) ** 2 + (dy - north) ** 2 + dz * dz
            else:
                off = (math.sqrt(dx * dx + dy * dy) - distance) ** 2 + dz * dz
            misfit = 0.5 * precision * off
            if known and not math.isnan(heading[j]):
                swing = heading[j] - heading[i] - turn
                swing -= 2 * math.pi * math.floor((swing + math.pi) / (2 * math.pi))
                misfit += 0.5 * turn_precision * swing * swing
            weights[e] = math.exp(-misfit) if misfit < MISFIT else 0.0
            total += weights[e]
        gone += _settle(p, i, targets, begin, count, weights, total, back, outside, moved)
    return negligible, gone


@_compiled
def along_by_speed(p, known, shares, prior, first, last, starts, offsets, weights, least, slight):  # type: ignore[no-untyped-def]
    """Along the sequences by one kernel for each speed, up to the ends; ``core.belief.speeds.forward`` says what of it.

    Args:
        p: float32 [n].
        known, shares: int32 [k] and float32 [k, S], the speeds at some places.
        prior: float32 [S], the speeds at all others.
        first, last: int32 [n], the bounds of each place's sequence.
        starts, offsets, weights: int64 [S + 1], int64 [m], float32 [m], the kernels behind each other.
        least: masses of places up to this are not moved.
        slight: nor are those of one speed at a place up to this.

    Returns:
        The places that are reached, int32 [r], the masses there by speed, float32 [r, S], and the sum of those that
        were not moved.
    """
    speeds = len(prior)
    at = np.full(len(p), -1, np.int32)
    for k in range(len(known)):
        at[known[k]] = k
    slots = np.full(len(p), -1, np.int32)
    reached, negligible = 0, 0.0
    for i in range(len(p)):
        if p[i] <= least:
            negligible += p[i]
            continue
        own = shares[at[i]] if at[i] >= 0 else prior
        for s in range(speeds):
            if p[i] * own[s] <= slight:
                continue
            low = min(max(i + offsets[starts[s]], first[i]), last[i] - 1)  # the offsets of a kernel ascend by one
            high = min(max(i + offsets[starts[s + 1] - 1], first[i]), last[i] - 1)
            for j in range(low, high + 1):
                if slots[j] < 0:
                    slots[j] = reached
                    reached += 1
    places, moved = np.empty(reached, np.int32), np.zeros((reached, speeds), np.float32)
    for i in range(len(p)):
        if slots[i] >= 0:
            places[slots[i]] = i
        if p[i] <= least:
            continue
        own = shares[at[i]] if at[i] >= 0 else prior
        for s in range(speeds):
            mass = p[i] * own[s]
            if mass <= slight:
                negligible += mass
                continue
            for k in range(starts[s], starts[s + 1]):
                j = min(max(i + offsets[k], first[i]), last[i] - 1)
                moved[slots[j], s] += mass * weights[k]
    return places, moved, negligible


@_compiled
def same_place(  # type: ignore[no-untyped-def]
    place, first, last, joined, kind, position, height, level, ordinal, radius, frames, storey
):
    """The same places by ``Whereabouts.near`` among those joined and those beside it in its sequence; ascending."""
    low, high = max(first, place - frames), min(last, place + frames + 1)
    found = np.empty(len(joined) + high - low, np.int64)
    count = 0
    for number in range(len(found)):
        beside = number >= len(joined)
        other = low + number - len(joined) if beside else joined[number]
        if other == place and not beside:
            continue
        if other != place:
            if level[other] != NO_LEVEL and level[place] != NO_LEVEL:
                if level[other] != level[place]:
                    continue
            elif abs(height[other] - height[place]) > storey:
                continue
        if kind[other] == kind[place] and kind[place] != NO_POSE:
            if beside and other != place and np.any(joined == other):
                continue
            apart = position[other] - position[place]
            up = 0.0 if kind[place] == METRIC else apart[2]
            distance = math.sqrt(apart[0] ** 2 + apart[1] ** 2 + up**2)
            same = distance <= radius or other == place
        else:
            same = beside and abs(ordinal[other] - ordinal[place]) <= frames
        if same:
            found[count] = other
            count += 1
    return np.sort(found[:count])
