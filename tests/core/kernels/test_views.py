"""What two views miss under both models, beside the formulas, and the normal equations beside differences."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.kernels import views

Array = NDArray[np.float64]
LEAST, NOISE, OUTLYING = 0.02, 0.01, 16.0


@pytest.fixture
def seen() -> tuple[Array, Array]:
    """Directions of 40 points in two cameras, some of them wrong."""
    random = np.random.default_rng(3)
    points = np.column_stack([random.uniform(-4, 4, 40), random.uniform(-2, 2, 40), random.uniform(3, 12, 40)])
    other = points + random.normal(0, 0.05, points.shape) - [0.4, 0, 0.3]
    return points / np.linalg.norm(points, axis=1, keepdims=True), other / np.linalg.norm(other, axis=1, keepdims=True)


def turned(vector: Array) -> Array:
    return np.asarray(cv2.Rodrigues(np.asarray(vector, np.float64))[0], np.float64)


ROTATION, CENTRE, TILT = turned(np.array([0.02, -0.05, 0.01])), np.array([0.05, -0.02, 0.04]), np.array([0.2, -0.3])
DIRECTION = np.array([0.8, 0.0, 0.6])
ACROSS = np.array([[0.6, 0.0], [0.0, 1.0], [-0.8, 0.0]])


def plane_squares(p: Array, q: Array, step: Array) -> Array:
    found = np.empty(len(p))
    rotation = turned(step[:3]) @ ROTATION
    views.plane_squares(p, q, rotation, CENTRE + step[3:6], TILT + step[6:], LEAST, found)
    return found


def rigid_squares(p: Array, q: Array, step: Array) -> Array:
    found, centre = np.empty(len(p)), DIRECTION + ACROSS @ step[3:]
    views.rigid_squares(p, q, turned(step[:3]) @ ROTATION, centre / np.linalg.norm(centre), found)
    return found


def test_squares_are_those_of_the_formulas(seen: tuple[Array, Array]) -> None:
    p, q = seen
    rays = (p - np.maximum(p @ np.r_[-TILT, 1.0], LEAST)[:, np.newaxis] * CENTRE) @ ROTATION.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    np.testing.assert_allclose(plane_squares(p, q, np.zeros(8)), np.square(rays - q).sum(axis=1) / 2)
    back = q @ ROTATION
    sizes = np.square(np.cross(DIRECTION, p)).sum(axis=1) + np.square(np.cross(DIRECTION, back)).sum(axis=1)
    missed = np.square(np.cross(p, back) @ DIRECTION) / sizes
    np.testing.assert_allclose(rigid_squares(p, q, np.zeros(5)), missed)


@pytest.mark.parametrize("model", ["plane", "rigid"])
def test_the_gradient_is_half_that_of_the_robust_cost(model: str, seen: tuple[Array, Array]) -> None:
    p, q = seen
    # Sampson's error is divided by a size that counts as constant.
    squares, size = (plane_squares, 8) if model == "plane" else (with_sizes(rigid_sizes(p, q)), 5)
    normal, gradient = np.zeros((size, size)), np.zeros(size)
    if model == "plane":
        views.plane_equations(p, q, ROTATION, CENTRE, TILT, LEAST, 1 / NOISE**2, OUTLYING, normal, gradient)
    else:
        views.rigid_equations(p, q, ROTATION, DIRECTION, ACROSS, 1 / NOISE**2, OUTLYING, normal, gradient)

    def cost(step: Array) -> float:
        square = squares(p, q, step) / NOISE**2
        return float((square / (1 + square / OUTLYING)).sum())

    slopes = [(cost(1e-6 * unit) - cost(-1e-6 * unit)) / 2e-6 for unit in np.eye(size)]
    np.testing.assert_allclose(2 * gradient, slopes, rtol=1e-3, atol=1e-3 * np.abs(slopes).max())
    np.testing.assert_allclose(normal, normal.T)
    assert np.linalg.eigvalsh(normal).min() > 0


def rigid_sizes(p: Array, q: Array) -> Array:
    back = q @ ROTATION
    return np.square(np.cross(DIRECTION, p)).sum(axis=1) + np.square(np.cross(DIRECTION, back)).sum(axis=1)


def with_sizes(sizes: Array) -> Callable[[Array, Array, Array], Array]:
    """What a rigid scene misses, with the sizes of its beginning."""

    def squares(p: Array, q: Array, step: Array) -> Array:
        back, centre = q @ (turned(step[:3]) @ ROTATION), DIRECTION + ACROSS @ step[3:]
        return np.square(np.cross(p, back) @ centre) / sizes

    return squares
