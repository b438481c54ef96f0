"""The compiled search for a fundamental matrix finds the matches of scenes, planes and turns among wrong ones."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from core.geometry.verification import fitting
from core.kernels.epipolar import (
    _make_singular,
    _matrices,
    _null_space,
    _rating,
    _roots,
    _smallest,
    fitting_neighbors,
)

Points = NDArray[np.float64]
SIZE = (320.0, 240.0)


def shown(world: Points, turn: float, centre: Points) -> Points:
    """Points, [n, 3], as a camera sees them that is turned about its vertical axis by radians; pixels, [n, 2]."""
    rotation = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
    rays = (world - centre) @ rotation.T
    return rays[:, :2] / rays[:, 2:] * 260 + np.array(SIZE) / 2


def scene(count: int, seed: int, plane: bool = False) -> Points:
    random = np.random.default_rng(seed)
    depths = np.full(count, 6.0) if plane else random.uniform(3, 12, count)
    return np.column_stack([random.uniform(-0.5, 0.5, (count, 2)) * depths[:, None], depths])


MOVES = {
    "a step aside": (0.02, (0.6, 0.0, 0.1), False),
    "a step ahead": (0.0, (0.05, 0.02, 1.0), False),
    "a turn alone": (0.15, (0.0, 0.0, 0.0), False),
    "a wall": (0.05, (0.5, 0.1, 0.3), True),
    "nothing": (0.0, (0.0, 0.0, 0.0), False),
}


@pytest.mark.parametrize(("turn", "centre", "plane"), MOVES.values(), ids=MOVES)
@pytest.mark.parametrize("right", [0.6, 0.8, 1.0])
def test_matches_of_one_scene_are_told_from_wrong_ones(
    turn: float, centre: tuple[float, ...], plane: bool, right: float
) -> None:
    world, random = scene(150, 3, plane), np.random.default_rng(4)
    query, candidate = shown(world, 0, np.zeros(3)), shown(world, turn, np.array(centre))
    query, candidate = (points + random.uniform(-0.3, 0.3, points.shape) for points in (query, candidate))
    wrong = np.arange(150) >= right * 150
    candidate[wrong] = random.uniform((0, 0), SIZE, (int(wrong.sum()), 2))
    found = fitting(query, candidate)
    assert found[~wrong].mean() > 0.9
    assert found[wrong].sum() <= 0.15 * wrong.sum()
    assert np.array_equal(found, fitting(query, candidate)), "it draws the same each time"


def test_each_candidate_is_judged_by_its_own_matches() -> None:
    """A keypoint without a match fits nothing; the numbers of a candidate's keypoints may be in any order."""
    world = scene(60, 5)
    query, near = shown(world, 0, np.zeros(3)), shown(world, 0.03, np.array([0.4, 0.0, 0.2]))
    order = np.random.default_rng(6).permutation(60)
    candidates = np.stack([near[order], np.random.default_rng(7).uniform((0, 0), SIZE, (60, 2)), near])
    neighbors = np.full((4, 60), -1, np.int32)
    neighbors[0] = np.argsort(order)
    neighbors[1], neighbors[2, ::2] = np.arange(60), np.arange(0, 60, 2)
    neighbors[3, :7] = np.arange(7)
    found = fitting_neighbors(neighbors, query, np.concatenate([candidates, near[None]]), 1.0, 250, 0.999)
    assert found.shape == (4, 60) and found[0].all() and found[1].sum() < 20
    assert found[2, ::2].all() and not found[2, 1::2].any()
    assert not found[3].any(), "seven matches say nothing"


def test_seven_matches_are_fitted_exactly_by_singular_matrices() -> None:
    random = np.random.default_rng(8)
    for _ in range(20):
        x, y, u, v = random.normal(size=(4, 7))
        rows = np.stack([u * x, u * y, u, v * x, v * y, v, x, y, np.ones(7)], axis=1)
        basis, matrices = np.empty((2, 9)), np.empty((3, 9))
        _null_space(rows.copy(), basis)
        np.testing.assert_allclose(rows @ basis.T, 0, atol=1e-9)
        count = _matrices(basis, np.empty(3), matrices)
        assert count in (1, 3)
        for matrix in matrices[:count]:
            np.testing.assert_allclose(rows @ matrix / np.linalg.norm(matrix), 0, atol=1e-8)
            assert abs(np.linalg.det(matrix.reshape(3, 3) / np.linalg.norm(matrix))) < 1e-8


@pytest.mark.parametrize("wanted", [(-2.0, 0.5, 3.0), (1.0, 1.0, 4.0), (0.25,)])
def test_roots_of_a_cubic_are_found(wanted: tuple[float, ...]) -> None:
    cubic = np.poly(wanted) if len(wanted) == 3 else np.polymul([1, -wanted[0]], [1, 1, 5])
    roots = np.empty(3)
    a, b, c, d = 2 * cubic
    found = roots[: _roots(a, b, c, d, roots)]
    assert len(found) and all(np.abs(np.polyval(cubic, found)) < 1e-9)
    if len(set(wanted)) != 2:  # one that two roots share may be missing
        assert sorted(found) == pytest.approx(wanted, abs=1e-6)


def test_lower_degrees_have_their_roots() -> None:
    roots = np.empty(3)
    assert _roots(0.0, 1.0, -3.0, 2.0, roots) == 2 and sorted(roots[:2]) == pytest.approx([1, 2])
    assert _roots(0.0, 0.0, 2.0, -1.0, roots) == 1 and roots[0] == pytest.approx(0.5)
    assert _roots(0.0, 1.0, 0.0, 1.0, roots) == 0
    assert _roots(0.0, 0.0, 0.0, 0.0, roots) == 1


def test_the_smallest_eigenvector_and_the_nearest_singular_matrix() -> None:
    random = np.random.default_rng(9)
    rows, vector, matrix = random.normal(size=(30, 9)), np.ones(9), random.normal(size=9)
    rows[:, 4] = 0.1 * random.normal(size=30) - rows[:, 2]
    _smallest(rows.T @ rows, vector)
    assert abs(vector @ np.linalg.svd(rows)[2][-1]) > 0.999
    left, values, right = np.linalg.svd(matrix.reshape(3, 3))
    _make_singular(matrix)
    np.testing.assert_allclose(matrix.reshape(3, 3), left @ np.diag([values[0], values[1], 0]) @ right, atol=1e-6)


def test_a_rating_counts_how_well_matches_fit() -> None:
    """For a shift to the right the epipolar lines are the rows: a match half a threshold beside one counts 1 - 1/8."""
    matrix = np.array([0.0, 0, 0, 0, 0, -1, 0, 1, 0])
    x, y = np.linspace(-1, 1, 8, dtype=np.float32), np.linspace(-1, 1, 8, dtype=np.float32)
    missed = np.array([0, 0, 0.05, 0.05, 0.1, 0.2, 1, 1], np.float32)
    rating = _rating(matrix, x, y, x + np.float32(0.3), y + missed, np.float32(0.01))
    wanted = 256 * np.clip(1 - missed**2 / 2 / 0.01, 0, 1).sum()
    assert rating == pytest.approx(wanted, abs=8)
