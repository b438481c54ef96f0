"""The compiled loops of a comparison of two views: what directions miss under two models, and the normal equations.

n points have the directions p in a place's camera and q in a query's, unit vectors [n, 3].  The query's camera has the
rotation R and the centre c (:mod:`core.geometry.pose`).  ``scale`` is one by the variance of what is missed; a square s
counts as s / (1 + s / outlying).
"""

from __future__ import annotations

import math

import numba
import numpy as np

HALF = math.sqrt(0.5)
"""Factor of what a plane misses, the difference of two directions that have the same noise."""


@numba.njit(cache=True, nogil=True)
def _ray(p, rotation, centre, tilt, least, ray):  # type: ignore[no-untyped-def]
    """Write the direction in which the query sees a point of a plane; its length, and the nearness before ``least``."""
    ahead = p[2] - tilt[0] * p[0] - tilt[1] * p[1]
    near = max(ahead, least)
    length = 0.0
    for i in range(3):
        ray[i] = 0.0
        for m in range(3):
            ray[i] += rotation[i, m] * (p[m] - centre[m] * near)
        length += ray[i] * ray[i]
    length = max(math.sqrt(length), 1e-9)
    for i in range(3):
        ray[i] /= length
    return length, ahead


@numba.njit(cache=True, nogil=True)
def plane_squares(p, q, rotation, centre, tilt, least, found):  # type: ignore[no-untyped-def]
    """Write to ``found`` the squares of what a plane misses, [n]; it is nowhere nearer than ``least`` allows."""
    ray = np.empty(3)
    for j in range(len(p)):
        _ray(p[j], rotation, centre, tilt, least, ray)
        found[j] = ((ray[0] - q[j, 0]) ** 2 + (ray[1] - q[j, 1]) ** 2 + (ray[2] - q[j, 2]) ** 2) / 2


@numba.njit(cache=True, nogil=True)
def plane_equations(  # type: ignore[no-untyped-def]
    p, q, rotation, centre, tilt, least, scale, outlying, normal, gradient
):
    """Add the points to the normal equations of a plane, [8, 8] and [8].

    The values are a rotation that follows R, a shift of c, and the tilt.
    """
    ray, missed, moved = np.empty(3), np.empty(3), np.empty(3)
    jacobian, tangent = np.zeros((3, 8)), np.empty((3, 3))
    for i in range(3):
        moved[i] = rotation[i, 0] * centre[0] + rotation[i, 1] * centre[1] + rotation[i, 2] * centre[2]
    for j in range(len(p)):
        length, ahead = _ray(p[j], rotation, centre, tilt, least, ray)
        near, total = max(ahead, least), 0.0
        for i in range(3):
            missed[i] = HALF * (ray[i] - q[j, i])
            total += missed[i] ** 2
            for m in range(3):
                tangent[i, m] = HALF * ((1.0 if i == m else 0.0) - ray[i] * ray[m]) / length
        jacobian[0, 1], jacobian[0, 2] = HALF * ray[2], -HALF * ray[1]
        jacobian[1, 0], jacobian[1, 2] = -HALF * ray[2], HALF * ray[0]
        jacobian[2, 0], jacobian[2, 1] = HALF * ray[1], -HALF * ray[0]
        for i in range(3):
            by_nearness = 0.0
            for m in range(3):
                by_nearness += tangent[i, m] * moved[m]
                jacobian[i, 3 + m] = 0.0
                for r in range(3):
                    jacobian[i, 3 + m] -= near * tangent[i, r] * rotation[r, m]
            jacobian[i, 6] = by_nearness * p[j, 0] if ahead > least else 0.0
            jacobian[i, 7] = by_nearness * p[j, 1] if ahead > least else 0.0
        weight = scale / (1 + total * scale / outlying) ** 2
        for i in range(3):
            for a in range(8):
                weighted = weight * jacobian[i, a]
                gradient[a] += weighted * missed[i]
                for b in range(8):
                    normal[a, b] += weighted * jacobian[i, b]


@numba.njit(cache=True, nogil=True)
def _cross(a, b, found):  # type: ignore[no-untyped-def]
    for i in range(3):
        k, m = (i + 1) % 3, (i + 2) % 3
        found[i] = a[k] * b[m] - a[m] * b[k]


@numba.njit(cache=True, nogil=True)
def _epipolar(p, q, rotation, centre, turned, normal, plane):  # type: ignore[no-untyped-def]
    """Write R^T q, c x p and p x R^T q of a point; the size by which what it misses is divided."""
    for i in range(3):
        turned[i] = rotation[0, i] * q[0] + rotation[1, i] * q[1] + rotation[2, i] * q[2]
    _cross(centre, turned, plane)
    size = plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2
    _cross(centre, p, normal)
    size += normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
    _cross(p, turned, plane)
    return max(math.sqrt(size), 1e-6)


@numba.njit(cache=True, nogil=True)
def rigid_squares(p, q, rotation, centre, found):  # type: ignore[no-untyped-def]
    """Write to ``found`` the squares of what a rigid scene misses, [n]: Sampson's error, on the sphere an angle."""
    turned, normal, plane = np.empty(3), np.empty(3), np.empty(3)
    for j in range(len(p)):
        size = _epipolar(p[j], q[j], rotation, centre, turned, normal, plane)
        found[j] = ((plane[0] * centre[0] + plane[1] * centre[1] + plane[2] * centre[2]) / size) ** 2


@numba.njit(cache=True, nogil=True)
def rigid_equations(  # type: ignore[no-untyped-def]
    p, q, rotation, centre, across, scale, outlying, normal, gradient
):
    """Add the points to the normal equations of a rigid scene, [5, 5] and [5].

    The values are a rotation that follows R, and steps along both columns of ``across``, [3, 2], which are at right
    angles to c.
    """
    turned, around, plane, moved, crossed = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    jacobian = np.empty(5)
    for j in range(len(p)):
        size = _epipolar(p[j], q[j], rotation, centre, turned, around, plane)
        missed = (plane[0] * centre[0] + plane[1] * centre[1] + plane[2] * centre[2]) / size
        for i in range(3):
            moved[i] = rotation[i, 0] * around[0] + rotation[i, 1] * around[1] + rotation[i, 2] * around[2]
        _cross(q[j], moved, crossed)
        for i in range(3):
            jacobian[i] = -crossed[i] / size
        for i in range(2):
            jacobian[3 + i] = (plane[0] * across[0, i] + plane[1] * across[1, i] + plane[2] * across[2, i]) / size
        weight = scale / (1 + missed**2 * scale / outlying) ** 2
        for a in range(5):
            gradient[a] += weight * jacobian[a] * missed
            for b in range(5):
                normal[a, b] += weight * jacobian[a] * jacobian[b]
