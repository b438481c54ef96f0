"""What two views miss under both models, and the normal equations, beside the formulas and their differences."""

from __future__ import annotations

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
    other[:4, 1] += 3
    return points / np.linalg.norm(points, axis=1, keepdims=True), other / np.linalg.norm(other, axis=1, keepdims=True)


def turned(vector: Array) -> Array:
    return np.asarray(cv2.Rodrigues(np.asarray(vector, np.float64))[0], np.float64)


ROTATION, CENTRE, TILT = turned(np.array([0.02, -0.05, 0.01])), np.array([0.05, -0.02, 0.04]), np.array([0.2, -0.3])
DIRECTION = np.array([0.8, 0.0, 0.6])
ACROSS = np.array([[0.6, 0.0], [0.0, 1.0], [-0.8, 0.0]])


def plane_misses(p: Array, q: Array, step: Array) -> Array:
    """What a plane misses after a step of its values, [n, 3]."""
    centre, tilt = CENTRE + step[3:6], TILT + step[6:]
    nearness = np.maximum(p @ np.r_[-tilt, 1.0], LEAST)
    rays = (p - nearness[:, np.newaxis] * centre) @ (turned(step[:3]) @ ROTATION).T
    return np.asarray((rays / np.linalg.norm(rays, axis=1, keepdims=True) - q) / np.sqrt(2))


def rigid_misses(p: Array, q: Array, step: Array) -> Array:
    """What a rigid scene misses after a step, [n, 1]; the size by which it is divided counts as constant."""
    back, centre = q @ (turned(step[:3]) @ ROTATION), DIRECTION + ACROSS @ step[3:]
    there = q @ ROTATION
    sizes = np.square(np.cross(DIRECTION, p)).sum(axis=1) + np.square(np.cross(DIRECTION, there)).sum(axis=1)
    return np.asarray(((np.cross(p, back) @ centre) / np.sqrt(sizes))[:, np.newaxis])


@pytest.mark.parametrize("model", ["plane", "rigid"])
def test_squares_and_normal_equations_are_those_of_the_formulas(model: str, seen: tuple[Array, Array]) -> None:
    p, q = seen
    misses, size = (plane_misses, 8) if model == "plane" else (rigid_misses, 5)
    found, normal, gradient = np.empty(len(p)), np.zeros((size, size)), np.zeros(size)
    if model == "plane":
        views.plane_squares(p, q, ROTATION, CENTRE, TILT, LEAST, found)
        views.plane_equations(p, q, ROTATION, CENTRE, TILT, LEAST, 1 / NOISE**2, OUTLYING, normal, gradient)
    else:
        views.rigid_squares(p, q, ROTATION, DIRECTION, found)
        views.rigid_equations(p, q, ROTATION, DIRECTION, ACROSS, 1 / NOISE**2, OUTLYING, normal, gradient)
    missed = misses(p, q, np.zeros(size))
    squares = np.square(missed).sum(axis=1)
    np.testing.assert_allclose(found, squares)
    assert squares.max() > 4 * OUTLYING * NOISE**2, "some points are wrong, and count little"
    weights = 1 / np.square(1 + squares / NOISE**2 / OUTLYING) / NOISE**2
    slopes = np.stack([(misses(p, q, 1e-6 * one) - misses(p, q, -1e-6 * one)) / 2e-6 for one in np.eye(size)], axis=2)
    wanted = np.einsum("n,nri,nrj->ij", weights, slopes, slopes)
    np.testing.assert_allclose(normal, wanted, rtol=1e-5, atol=1e-6 * wanted.max())
    wanted = np.einsum("n,nri,nr->i", weights, slopes, missed)
    np.testing.assert_allclose(gradient, wanted, rtol=1e-5, atol=1e-6 * np.abs(wanted).max())
