"""The compiled loops of a bundle adjustment: what directions miss, and its derivatives.

A query's camera, number 0, and k places have attitudes float64 [k + 1, 3, 3] and positions [k + 1, 3].  Points have
bearings [n, 3] in the axes of the query's camera and a nearness ρ each, [n].  Observation o says that place
``place[o]`` (from 1) sees point ``point[o]`` in the direction ``seen[o]`` of its axes; ``scale[o]`` is one by the
variance of what is missed.  With v = A b + ρ (c - c_k), that is v / |v| - A_k p.  A square s counts as
s / (1 + s / outlying).
"""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def _turned(attitude, vector, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        out[i] = attitude[i, 0] * vector[0] + attitude[i, 1] * vector[1] + attitude[i, 2] * vector[2]


@numba.njit(cache=True, nogil=True)
def nearest(bearings, point, place, seen, attitudes, positions, most, nearness):  # type: ignore[no-untyped-def]
    """Write to ``nearness`` at which one each point's directions come nearest to each other: 0 to ``most``."""
    above, below = np.zeros(len(bearings)), np.full(len(bearings), 1e-9)
    ray, ahead = np.empty(3), np.empty(3)
    for o in range(len(point)):
        j, k = point[o], place[o]
        _turned(attitudes[k], seen[o], ray)
        _turned(attitudes[0], bearings[j], ahead)
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            moved = ray[a] * (positions[0, b] - positions[k, b]) - ray[b] * (positions[0, a] - positions[k, a])
            above[j] -= (ray[a] * ahead[b] - ray[b] * ahead[a]) * moved
            below[j] += moved * moved
    for j in range(len(bearings)):
        nearness[j] = min(max(above[j] / below[j], 0.0), most)


@numba.njit(cache=True, nogil=True)
def squares(  # type: ignore[no-untyped-def]
    bearings, point, place, seen, scale, attitudes, positions, nearness, found
):
    """Write to ``found`` the squares of what observations miss, by their variances, float64 [o]."""
    ray, v = np.empty(3), np.empty(3)
    for o in range(len(point)):
        j, k = point[o], place[o]
        _turned(attitudes[k], seen[o], ray)
        _turned(attitudes[0], bearings[j], v)
        length = 0.0
        for i in range(3):
            v[i] += nearness[j] * (positions[0, i] - positions[k, i])
            length += v[i] * v[i]
        length = max(math.sqrt(length), 1e-9)
        total = 0.0
        for i in range(3):
            total += (v[i] / length - ray[i]) ** 2
        found[o] = total * scale[o]


@numba.njit(cache=True, nogil=True)
def normal_equations(  # type: ignore[no-untyped-def]
    bearings, point, place, seen, scale, attitudes, positions, nearness, outlying,
    poses, poses_gradient, diagonal, slope, mixed,
):  # fmt: skip
    """Add the observations to the normal equations.

    Values are a rotation about the world's axes that follows the attitude and a shift, for each camera, and nearnesses.
    ``poses`` is [6 k + 6, 6 k + 6] with the gradient [6 k + 6], ``diagonal`` and ``slope`` are those of nearnesses,
    [n], and ``mixed`` is [n, 6 k + 6].
    """
    ray, ahead, v, missed, by_nearness = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    jacobian, tangent = np.zeros((3, 12)), np.empty((3, 3))
    for o in range(len(point)):
        j, k = point[o], place[o]
        near = nearness[j]
        _turned(attitudes[k], seen[o], ray)
        _turned(attitudes[0], bearings[j], ahead)
        length = 0.0
        for i in range(3):
            v[i] = ahead[i] + near * (positions[0, i] - positions[k, i])
            length += v[i] * v[i]
        length = max(math.sqrt(length), 1e-9)
        total = 0.0
        for i in range(3):
            v[i] /= length
            missed[i] = v[i] - ray[i]
            total += missed[i] ** 2
        weight = scale[o] / (1 + total * scale[o] / outlying) ** 2
        for i in range(3):
            for m in range(3):
                tangent[i, m] = ((1.0 if i == m else 0.0) - v[i] * v[m]) / length
        for i in range(3):
            by_nearness[i] = 0.0
            for m in range(3):
                by_nearness[i] += tangent[i, m] * (positions[0, m] - positions[k, m])
                jacobian[i, 3 + m] = near * tangent[i, m]
                jacobian[i, 9 + m] = -near * tangent[i, m]
                a, b = (m + 1) % 3, (m + 2) % 3
                jacobian[i, m] = tangent[i, b] * ahead[a] - tangent[i, a] * ahead[b]
                jacobian[i, 6 + m] = 0.0
        jacobian[0, 7], jacobian[0, 8] = -ray[2], ray[1]
        jacobian[1, 6], jacobian[1, 8] = ray[2], -ray[0]
        jacobian[2, 6], jacobian[2, 7] = -ray[1], ray[0]
        for i in range(3):
            diagonal[j] += weight * by_nearness[i] ** 2
            slope[j] += weight * by_nearness[i] * missed[i]
        for p in range(12):
            row = p if p < 6 else 6 * k + p - 6
            for i in range(3):
                weighted = weight * jacobian[i, p]
                poses_gradient[row] += weighted * missed[i]
                mixed[j, row] += weighted * by_nearness[i]
                for q in range(12):
                    poses[row, q if q < 6 else 6 * k + q - 6] += weighted * jacobian[i, q]
