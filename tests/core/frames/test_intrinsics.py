"""Intrinsics: pixels to directions and back with every distortion model, frames of other sizes, and what cannot be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from core.errors import UnfitIntrinsics
from core.frames.intrinsics import Intrinsics

CAMERA: dict[str, Any] = {"width": 752, "height": 480, "fx": 458.0, "fy": 457.0, "cx": 367.0, "cy": 248.0}
LENSES = [
    ("none", ()),
    ("plumb_bob", (-0.28, 0.07, 0.0002, 0.00002)),
    ("plumb_bob", (-0.41, 0.18, 0.001, -0.001, -0.02)),
    ("rational_polynomial", (-0.4, 0.1, 0.0, 0.0, 0.01, -0.1, 0.05, 0.0)),
    ("equidistant", (-0.01, 0.02, -0.02, 0.005)),
]


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_a_direction_is_seen_where_it_was_computed_for(model: str, coefficients: tuple[float, ...]) -> None:
    camera = Intrinsics.model_validate(CAMERA | {"distortion_model": model, "distortion": coefficients})
    points = np.random.default_rng(0).uniform((0, 0), (752, 480), (200, 2))
    rays = camera.bearings(points)
    assert np.linalg.norm(rays, axis=1) == pytest.approx(1)
    assert camera.project(rays) == pytest.approx(points, abs=1e-3)


def test_the_principal_point_looks_ahead_and_counts_from_the_first_pixels_centre() -> None:
    camera = Intrinsics.model_validate(CAMERA)
    assert camera.bearings(np.array([[367.5, 248.5]]))[0] == pytest.approx([0, 0, 1])
    right = camera.bearings(np.array([[367.5 + 458, 248.5]]))[0]
    assert right == pytest.approx([0.5**0.5, 0, 0.5**0.5])
    assert camera.bearings(np.zeros((0, 2))).shape == (0, 3)


@pytest.mark.parametrize(("width", "height"), [(752, 480), (376, 240), (1504, 960), (501, 320), (500, 320), (188, 120)])
def test_a_scaled_frame_has_the_same_directions(width: int, height: int) -> None:
    camera = Intrinsics.model_validate(CAMERA | {"distortion_model": "equidistant", "distortion": (0.01, 0, 0, 0)})
    scaled = camera.of_size(width, height)
    points = np.array([[0.0, 0.0], [752, 480], [100, 300]])
    small = points * [width / 752, height / 480]
    assert (scaled.width, scaled.height) == (width, height)
    assert scaled.bearings(small) == pytest.approx(camera.bearings(points), abs=1e-6)


@pytest.mark.parametrize(("width", "height"), [(480, 752), (640, 480), (752, 482), (0, 0), (376, 243)])
def test_a_frame_of_another_shape_is_refused(width: int, height: int) -> None:
    with pytest.raises(UnfitIntrinsics, match="752 x 480"):
        Intrinsics.model_validate(CAMERA).of_size(width, height)


def test_no_direction_where_the_distortion_cannot_be_undone() -> None:
    """The picture of this lens ends before its corners; they hold other light."""
    camera = Intrinsics.model_validate(CAMERA | {"distortion_model": "plumb_bob", "distortion": (-0.2, 0, 0, 0)})
    rays = camera.bearings(np.array([[376.0, 240.0], [0.0, 0.0]]))
    assert np.isfinite(rays[0]).all() and np.isnan(rays[1]).all()


@pytest.mark.parametrize(
    "change",
    [
        {"fx": 0},
        {"fy": -1},
        {"fx": float("nan")},
        {"fy": float("inf")},
        {"fx": 1e9},
        {"fx": 2000, "fy": 400},
        {"cx": -1},
        {"cy": 481},
        {"width": 8},
        {"width": 752.5},
        {"fx": "458"},
        {"distortion": (0.1,)},
        {"distortion_model": "plumb_bob"},
        {"distortion_model": "plumb_bob", "distortion": (-5, 0, 0, 0)},
        {"distortion_model": "plumb_bob", "distortion": (1e9, 0, 0, 0)},
        {"distortion_model": "rational_polynomial", "distortion": (0,) * 5},
        {"distortion_model": "equidistant", "distortion": (1e6, 0, 0, 0)},
        {"distortion_model": "equidistant", "distortion": (-3, 0, 0, 0)},
        {"distortion_model": "plumb_bob", "distortion": (0, 0, 0, float("nan"))},
    ],
)
def test_what_no_camera_has_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Intrinsics.model_validate(CAMERA | change)
