"""The compiled loops of projections give what the projection is defined as, and values rounded to whole steps."""

from __future__ import annotations

import numpy as np
import pytest

import core.kernels.projections
from core.kernels.projections import ConstantMatrix, quantize
from core.method.projection import Projection


@pytest.mark.parametrize(("count", "length", "values"), [(5, 6, 3), (300, 384, 128), (0, 4, 2)])
def test_finished_products_are_projections(count: int, length: int, values: int) -> None:
    generator = np.random.default_rng(length)
    mean = (generator.random(length) / length).astype(np.float32)
    projection = Projection(mean, generator.standard_normal((length, values + 2)).astype(np.float32))
    features = generator.random((count, length)).astype(np.float32)
    features[1:2] = 0
    made = projection.finish(projection.products(features), features, values)
    np.testing.assert_allclose(made, projection(features, values), atol=1e-5)


def test_quantized_values_are_rounded_and_cut_off() -> None:
    values = np.random.default_rng(0).standard_normal((30, 20)).astype(np.float32)
    made = np.empty((30, 40), np.int8)
    quantize(values, 100.0, made[:, 10:30])
    np.testing.assert_array_equal(made[:, 10:30], np.clip(np.rint(values * np.float64(100)), -127, 127))


@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("offset", [True, False])
@pytest.mark.parametrize(("count", "length", "values"), [(1, 3, 2), (169, 384, 128), (600, 128, 64), (0, 5, 4)])
def test_gives_what_numpy_gives(
    count: int, length: int, values: int, offset: bool, ordered: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not ordered:
        monkeypatch.setattr(core.kernels.projections, "_ordered", lambda matrix: None)
    generator = np.random.default_rng(count)
    matrix = generator.standard_normal((length, values)).astype(np.float32)
    added = generator.standard_normal(values).astype(np.float32) if offset else None
    vectors = generator.standard_normal((count, length)).astype(np.float32)
    made = ConstantMatrix(matrix, added)(vectors)
    wanted = vectors.astype(np.float64) @ matrix.astype(np.float64) + (0 if added is None else added)
    assert made.shape == (count, values) and made.dtype == np.float32
    np.testing.assert_allclose(made, wanted, atol=1e-4)


def test_vectors_may_lie_scattered_in_memory() -> None:
    generator = np.random.default_rng(0)
    matrix, wide = generator.random((6, 3)).astype(np.float32), generator.random((4, 12)).astype(np.float32)
    np.testing.assert_allclose(ConstantMatrix(matrix)(wide[:, ::2]), wide[:, ::2] @ matrix, rtol=1e-5)


def test_the_result_is_its_own_and_can_be_written_to() -> None:
    matrix = ConstantMatrix(np.eye(2, dtype=np.float32))
    first = matrix(np.ones((1, 2), np.float32))
    first[:] = 7
    np.testing.assert_array_equal(matrix(np.ones((1, 2), np.float32)), np.ones((1, 2)))
