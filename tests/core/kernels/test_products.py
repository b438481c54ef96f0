"""Products with a constant matrix against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

import core.kernels.products
from core.kernels.products import ConstantMatrix


@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("offset", [True, False])
@pytest.mark.parametrize(("count", "length", "values"), [(1, 3, 2), (169, 384, 128), (600, 128, 64), (0, 5, 4)])
def test_gives_what_numpy_gives(
    count: int, length: int, values: int, offset: bool, ordered: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not ordered:
        monkeypatch.setattr(core.kernels.products, "_ordered", lambda matrix: None)
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
