"""The discriminant projection on features whose nuisance directions are known."""

from __future__ import annotations

import numpy as np
import pytest

from core.method.equations import unit_length
from core.method.projection import Projection, fit_projection


def test_what_conditions_change_is_left_out_and_what_tells_spots_apart_is_kept() -> None:
    generator = np.random.default_rng(0)
    spot = generator.standard_normal((4000, 3)).astype(np.float32)  # the first three directions tell spots apart
    clear = np.hstack([spot, generator.standard_normal((4000, 5)).astype(np.float32)])
    changed = np.hstack([spot, generator.standard_normal((4000, 5)).astype(np.float32)])
    projection = fit_projection(clear, changed, 3)
    share = np.linalg.norm(projection.matrix[:3], axis=0) / np.linalg.norm(projection.matrix, axis=0)
    assert (share > 0.99).all()


def test_projected_features_have_unit_length_and_ignore_the_length_they_came_with() -> None:
    generator = np.random.default_rng(1)
    projection = Projection(
        generator.standard_normal(6).astype(np.float32) * np.float32(0.1),
        generator.standard_normal((6, 4)).astype(np.float32),
    )
    features = generator.random((5, 6)).astype(np.float32)
    made = projection(features, 3)
    centred = unit_length(features) - projection.mean
    expected = unit_length(np.asarray(centred @ projection.matrix[:, :3], np.float32))
    np.testing.assert_allclose(made, expected, atol=1e-5)
    np.testing.assert_allclose(projection(features * 7, 3), made, atol=1e-5)


def test_a_blank_feature_stays_blank() -> None:
    projection = Projection(np.ones(2, np.float32), np.eye(2, dtype=np.float32))
    np.testing.assert_array_equal(projection(np.zeros((2, 2), np.float32), 2), np.zeros((2, 2)))
    assert projection(np.zeros((0, 2), np.float32), 2).shape == (0, 2)


def test_fewer_directions_are_the_first_of_more() -> None:
    generator = np.random.default_rng(2)
    a, b = (generator.random((50, 6)).astype(np.float32) for _ in range(2))
    many, few = fit_projection(a, b, 6), fit_projection(a, b, 2)
    np.testing.assert_allclose(np.abs(many.matrix[:, :2]), np.abs(few.matrix), rtol=1e-4)


@pytest.mark.parametrize(("shape", "other", "values"), [((5, 3), (4, 3), 2), ((1, 3), (1, 3), 2), ((5, 3), (5, 3), 4)])
def test_what_cannot_be_fitted_is_refused(shape: tuple[int, int], other: tuple[int, int], values: int) -> None:
    with pytest.raises(ValueError, match="directions from pairs"):
        fit_projection(np.ones(shape, np.float32), np.ones(other, np.float32), values)
