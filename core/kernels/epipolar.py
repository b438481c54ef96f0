"""The compiled search for the fundamental matrix that most matches of two pictures fit.

A match is a point (x, y) of one picture and a point (u, v) of the other.  Seven matches, drawn at random, leave at most
three matrices that they fit exactly (Hartley and Zisserman, Multiple View Geometry, section 11.1.2).  All matches rate
each: one whose Sampson distance is d (section 11.4.3) counts as 1 - d² / t², or not at all beyond the threshold t.
Whatever rates higher than what was drawn before is refined by least squares over the matches near it (Chum, Matas and
Kittler, "Locally optimized RANSAC", 2003).  The drawing ends when a better matrix would have been drawn by now.

Views of a plane and of a camera that only turns leave the matrix open.  Any that fits them all will do, so no draw is
thrown away as degenerate.  Ratings are whole numbers, and the same matches always give the same matrix.
"""

from __future__ import annotations

import math

import numba
import numpy as np

DRAWN = 7
"""Matches of a draw."""
REFINEMENTS, WIDTH = 3, 2.0
"""Steps of least squares.  The first sees matches to WIDTH² times the squared threshold, the second to WIDTH times it,
for a matrix of seven rounded points is hardly exact."""
UNIT = 256
"""The rating of one match that fits exactly."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _null_space(rows, basis):  # type: ignore[no-untyped-def]
    """Write two vectors, [2, 9], of unit length that equations [7, 9] send to zero; the equations are overwritten."""
    columns, found = np.arange(9), np.empty(9)
    for k in range(7):
        row, column, highest = k, k, -1.0
        for i in range(k, 7):
            for j in range(k, 9):
                if abs(rows[i, j]) > highest:
                    highest, row, column = abs(rows[i, j]), i, j
        if highest < 1e-12:  # the equations left say nothing, as between a picture and itself
            for i in range(k, 7):
                for j in range(k, 9):
                    rows[i, j] = 0.0
                rows[i, i] = 1.0
            break
        for j in range(9):
            rows[k, j], rows[row, j] = rows[row, j], rows[k, j]
        for i in range(7):
            rows[i, k], rows[i, column] = rows[i, column], rows[i, k]
        columns[k], columns[column] = columns[column], columns[k]
        for i in range(k + 1, 7):
            factor = rows[i, k] / rows[k, k]
            for j in range(k, 9):
                rows[i, j] -= factor * rows[k, j]
    for one in range(2):
        found[7], found[8] = 1.0 - one, 1.0 * one
        square = 1.0
        for k in range(6, -1, -1):
            total = 0.0
            for j in range(k + 1, 9):
                total += rows[k, j] * found[j]
            found[k] = -total / rows[k, k]
            square += found[k] * found[k]
        for k in range(9):
            basis[one, columns[k]] = found[k] / math.sqrt(square)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _determinant(basis, share, matrix):  # type: ignore[no-untyped-def]
    """Write share · F + (1 - share) · G of a basis F, G, [9], and return its determinant."""
    for k in range(9):
        matrix[k] = share * basis[0, k] + (1 - share) * basis[1, k]
    return (
        matrix[0] * (matrix[4] * matrix[8] - matrix[5] * matrix[7])
        - matrix[1] * (matrix[3] * matrix[8] - matrix[5] * matrix[6])
        + matrix[2] * (matrix[3] * matrix[7] - matrix[4] * matrix[6])
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _roots(a, b, c, d, roots):  # type: ignore[no-untyped-def]
    """Write the real roots of a x³ + b x² + c x + d, and return how many there are; 1 where every x is one."""
    highest = max(abs(a), abs(b), abs(c), abs(d))
    if highest < 1e-14:
        roots[0] = 1.0
        return 1
    if abs(a) < 1e-10 * highest:
        if abs(b) < 1e-10 * highest:
            roots[0] = -d / c if c != 0.0 else 1.0
            return 1
        square = c * c - 4 * b * d
        if square < 0:
            return 0
        roots[0], roots[1] = (-c + math.sqrt(square)) / (2 * b), (-c - math.sqrt(square)) / (2 * b)
        return 2
    b, c, d = b / a, c / a, d / a
    q, r = (b * b - 3 * c) / 9, (2 * b * b * b - 9 * b * c + 27 * d) / 54
    if r * r < q * q * q:
        angle = math.acos(r / math.sqrt(q * q * q))
        for k in range(3):
            roots[k] = -2 * math.sqrt(q) * math.cos((angle + 2 * math.pi * k) / 3) - b / 3
        return 3
    root = -math.copysign((abs(r) + math.sqrt(max(0.0, r * r - q * q * q))) ** (1 / 3), r)
    roots[0] = root + (q / root if root != 0.0 else 0.0) - b / 3
    return 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _matrices(basis, roots, matrices):  # type: ignore[no-untyped-def]
    """Write the matrices of determinant 0 among x F + (1 - x) G, at most [3, 9], and return how many there are."""
    matrix = matrices[0]
    d = _determinant(basis, 0.0, matrix)
    ahead, behind = _determinant(basis, 1.0, matrix), _determinant(basis, -1.0, matrix)
    b = (ahead + behind) / 2 - d
    a = (_determinant(basis, 2.0, matrix) - 4 * b - d - (ahead - behind)) / 6
    count = _roots(a, b, (ahead - behind) / 2 - a, d, roots)
    for k in range(count):
        _determinant(basis, roots[k], matrices[k])
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rating(matrix, x, y, u, v, limit):  # type: ignore[no-untyped-def]
    """The rating of a matrix, [9], by matches, float32 [n] each; ``limit`` is the squared threshold, float32."""
    a, b, c = np.float32(matrix[0]), np.float32(matrix[1]), np.float32(matrix[2])
    d, e, f = np.float32(matrix[3]), np.float32(matrix[4]), np.float32(matrix[5])
    g, h, k = np.float32(matrix[6]), np.float32(matrix[7]), np.float32(matrix[8])
    unit, least, lost = np.float32(UNIT), np.float32(1e-30), np.int32(0)
    for i in range(len(x)):
        first, second = a * x[i] + b * y[i] + c, d * x[i] + e * y[i] + f
        third, fourth = a * u[i] + d * v[i] + g, b * u[i] + e * v[i] + h
        missed = u[i] * first + v[i] * second + g * x[i] + h * y[i] + k
        slope = first * first + second * second + third * third + fourth * fourth
        lost = np.int32(lost + np.int32(min(unit * missed * missed / (slope * limit + least), unit)))
    return np.int32(UNIT * len(x) - lost)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _squares(matrix, x, y, u, v, squares, slopes):  # type: ignore[no-untyped-def]
    """Write the squared Sampson distances of matches, [n], and the reciprocal squares of their slopes."""
    for i in range(len(x)):
        first, second = matrix[0] * x[i] + matrix[1] * y[i] + matrix[2], matrix[3] * x[i] + matrix[4] * y[i] + matrix[5]
        third, fourth = matrix[0] * u[i] + matrix[3] * v[i] + matrix[6], matrix[1] * u[i] + matrix[4] * v[i] + matrix[7]
        missed = u[i] * first + v[i] * second + matrix[6] * x[i] + matrix[7] * y[i] + matrix[8]
        slopes[i] = 1 / (first * first + second * second + third * third + fourth * fourth + 1e-30)
        squares[i] = missed * missed * slopes[i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _smallest(equations, vector):  # type: ignore[no-untyped-def]
    """Turn a vector, [9], into the eigenvector of the smallest eigenvalue of normal equations, by inverse iteration.

    Args:
        equations: [9, 9], of which the upper half is read.
    """
    size, trace = len(vector), 0.0
    for i in range(size):
        trace += equations[i, i]
    least, lower = 1e-12 * trace + 1e-300, np.zeros((size, size))
    for j in range(size):  # Cholesky
        total = equations[j, j] + least
        for k in range(j):
            total -= lower[j, k] * lower[j, k]
        lower[j, j] = math.sqrt(max(total, 1e-3 * least))
        for i in range(j + 1, size):
            total = equations[j, i]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = total / lower[j, j]
    for _ in range(4):
        square = 0.0
        for i in range(size):
            for k in range(i):
                vector[i] -= lower[i, k] * vector[k]
            vector[i] /= lower[i, i]
        for i in range(size - 1, -1, -1):
            for k in range(i + 1, size):
                vector[i] -= lower[k, i] * vector[k]
            vector[i] /= lower[i, i]
            square += vector[i] * vector[i]
        for i in range(size):
            vector[i] /= math.sqrt(square)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _make_singular(matrix):  # type: ignore[no-untyped-def]
    """Turn a matrix, [9], into the nearest of determinant 0: F - (F e) eᵀ, e being its least singular vector."""
    square, inverse = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            square[i, j] = matrix[i] * matrix[j] + matrix[3 + i] * matrix[3 + j] + matrix[6 + i] * matrix[6 + j]
    for i in range(3):  # the cofactors of FᵀF: its inverse, but for the length
        for j in range(3):
            k, m, p, q = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            inverse[i, j] = square[k, p] * square[m, q] - square[k, q] * square[m, p]
    longest = 0
    for k in range(1, 3):
        if inverse[k, k] > inverse[longest, longest]:
            longest = k
    least = inverse[longest].copy()
    for _ in range(4):
        length = math.sqrt(least[0] * least[0] + least[1] * least[1] + least[2] * least[2])
        if length == 0.0:
            return
        zero, one, two = least[0] / length, least[1] / length, least[2] / length
        for i in range(3):
            least[i] = inverse[i, 0] * zero + inverse[i, 1] * one + inverse[i, 2] * two
    for i in range(3):
        along = matrix[3 * i] * zero + matrix[3 * i + 1] * one + matrix[3 * i + 2] * two
        matrix[3 * i] -= along * zero
        matrix[3 * i + 1] -= along * one
        matrix[3 * i + 2] -= along * two


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _refine(matrix, x, y, u, v, limit, squares, slopes):  # type: ignore[no-untyped-def]
    """One step of least squares over the matches within a squared distance; False where fewer than eight are.

    A match of the squared distance d² has the weight (1 - d² / limit)².
    """
    _squares(matrix, x, y, u, v, squares, slopes)
    equations, row = np.zeros((9, 9)), np.empty(9)
    near = 0
    for i in range(len(x)):
        if squares[i] < limit:
            near += 1
            row[0], row[1], row[2] = u[i] * x[i], u[i] * y[i], u[i]
            row[3], row[4], row[5] = v[i] * x[i], v[i] * y[i], v[i]
            row[6], row[7], row[8] = x[i], y[i], 1.0
            weight = slopes[i] * (1 - squares[i] / limit) ** 2
            for j in range(9):
                weighted = weight * row[j]
                for k in range(j, 9):
                    equations[j, k] += weighted * row[k]
    if near <= DRAWN:
        return False
    _smallest(equations, matrix)
    _make_singular(matrix)
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draws(fitting, count, certainty):  # type: ignore[no-untyped-def]
    """After how many draws one of seven fitting matches has come, with a certainty, if so many of ``count`` fit."""
    chance = (fitting / count) ** DRAWN
    if chance < 1e-9:
        return np.inf
    return 1.0 if chance > 1 - 1e-9 else math.ceil(math.log(1 - certainty) / math.log(1 - chance))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fit(points, threshold, most, certainty, matrix, fits):  # type: ignore[no-untyped-def]
    """Write the fundamental matrix, [9], that most of the matches, [4, n], fit, and which do, [n]; n is at least 8."""
    count, limit = points.shape[1], threshold * threshold
    x, y, u, v = points[0], points[1], points[2], points[3]
    rough = points.astype(np.float32)
    rough_x, rough_y, rough_u, rough_v, rough_limit = rough[0], rough[1], rough[2], rough[3], np.float32(limit)
    order, rows, basis, roots = np.arange(count), np.empty((DRAWN, 9)), np.empty((2, 9)), np.empty(3)
    matrices, refined = np.empty((3, 9)), np.empty(9)
    squares, slopes = np.empty(count), np.empty(count)
    matrix[:] = 0.0
    best, best_drawn = np.int32(-1), np.int32(-1)
    state, draw, wanted = np.uint64(0x9E3779B97F4A7C15), 0, float(most)
    while draw < wanted:
        draw += 1
        for j in range(DRAWN):
            state ^= state << np.uint64(13)  # Marsaglia's xorshift
            state ^= state >> np.uint64(7)
            state ^= state << np.uint64(17)
            at = j + np.int64((state >> np.uint64(33)) % np.uint64(count - j))
            order[j], order[at] = order[at], order[j]
            i = order[j]
            rows[j, 0], rows[j, 1], rows[j, 2] = u[i] * x[i], u[i] * y[i], u[i]
            rows[j, 3], rows[j, 4], rows[j, 5] = v[i] * x[i], v[i] * y[i], v[i]
            rows[j, 6], rows[j, 7], rows[j, 8] = x[i], y[i], 1.0
        _null_space(rows, basis)
        for k in range(_matrices(basis, roots, matrices)):
            rating = _rating(matrices[k], rough_x, rough_y, rough_u, rough_v, rough_limit)
            if rating <= best_drawn:
                continue
            best_drawn = rating
            if rating > best:
                best = rating
                matrix[:] = matrices[k]
            refined[:] = matrices[k]
            for step in range(REFINEMENTS):
                if not _refine(refined, x, y, u, v, limit * WIDTH ** max(0, 2 - step), squares, slopes):
                    break
                rating = _rating(refined, rough_x, rough_y, rough_u, rough_v, rough_limit)
                if rating > best:
                    best = rating
                    matrix[:] = refined
            _squares(matrix, x, y, u, v, squares, slopes)
            wanted = min(wanted, _draws((squares <= limit).sum(), count, certainty))
    _squares(matrix, x, y, u, v, squares, slopes)
    fits[:] = squares <= limit


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _are_on_lines(matrix, points, threshold, fits):  # type: ignore[no-untyped-def]
    """Whether half of the matches that fit are near a line of the nearest matrix l' lᵀ of rank 1, of l and l'."""
    square, line, other = np.empty((3, 3)), np.ones(3), np.empty(3)
    for i in range(3):
        for j in range(3):
            square[i, j] = matrix[i] * matrix[j] + matrix[3 + i] * matrix[3 + j] + matrix[6 + i] * matrix[6 + j]
    for _ in range(32):  # the singular vector of the largest singular value, by power iteration
        for i in range(3):
            other[i] = square[i, 0] * line[0] + square[i, 1] * line[1] + square[i, 2] * line[2]
        length = math.sqrt(other[0] * other[0] + other[1] * other[1] + other[2] * other[2])
        if length == 0.0:
            return False
        for i in range(3):
            line[i] = other[i] / length
    for i in range(3):
        other[i] = matrix[3 * i] * line[0] + matrix[3 * i + 1] * line[1] + matrix[3 * i + 2] * line[2]
    near, ours, theirs = 0, math.hypot(line[0], line[1]), math.hypot(other[0], other[1])
    for i in range(points.shape[1]):
        if fits[i]:
            mine = abs(line[0] * points[0, i] + line[1] * points[1, i] + line[2])
            its = abs(other[0] * points[2, i] + other[1] * points[3, i] + other[2])
            near += mine <= threshold * ours or its <= threshold * theirs
    return 2 * near > fits.sum()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fitting_neighbors(neighbors, query, candidates, threshold, most, certainty):  # type: ignore[no-untyped-def]
    """Which keypoints of a query fit the fundamental matrix that most of its matches with a candidate fit.

    Args:
        neighbors: int32 [k, n], the number of the keypoint in each candidate that matches; -1: none does.
        query: float64 [n, 2], positions in pixels, finite.
        candidates: float64 [k, m, 2], likewise.
        threshold: pixels by which a match may miss, by the Sampson distance.
        most: draws at most.
        certainty: of having drawn seven matches that fit the matrix, with which fewer draws do.

    Returns:
        bool [k, n]; none of a candidate with fewer than eight matches, or where half of those that fit do so only
        because they are on one line.
    """
    found, matrix = np.zeros(neighbors.shape, np.bool_), np.empty(9)
    for k in range(len(neighbors)):
        matched = np.flatnonzero(neighbors[k] >= 0)
        count = len(matched)
        if count <= DRAWN:
            continue
        points, fits = np.empty((4, count)), np.empty(count, np.bool_)
        for i in range(count):
            there = neighbors[k, matched[i]]
            points[0, i], points[1, i] = query[matched[i], 0], query[matched[i], 1]
            points[2, i], points[3, i] = candidates[k, there, 0], candidates[k, there, 1]
        scale = 0.0  # about the origin, with coordinates of 1 in the root mean square, numbers have the same weight
        for j in range(4):
            points[j] -= points[j].sum() / count
            scale += (points[j] * points[j]).sum()
        scale = math.sqrt(scale / points.size)
        if scale == 0.0:
            continue
        points /= scale
        _fit(points, threshold / scale, most, certainty, matrix, fits)
        if not _are_on_lines(matrix, points, 2 * threshold / scale, fits):
            for i in range(count):
                found[k, matched[i]] = fits[i]
    return found
