"""Sum-, Max-, Cross-Pool and Whole on activations small enough to pool by hand."""

from __future__ import annotations

import numpy as np
import pytest

from core.baselines.pooling import cross_pool, max_pool, sum_pool, whole

MAPS = np.array([[[1, 0], [2, 5]], [[0, 3], [4, 0]]], np.float32)  # two rows, two columns, two maps


def test_sum_pool() -> None:
    np.testing.assert_array_equal(sum_pool(MAPS), [7, 8])


def test_max_pool() -> None:
    np.testing.assert_array_equal(max_pool(MAPS), [4, 5])


def test_whole() -> None:
    np.testing.assert_array_equal(whole(MAPS), [1, 0, 2, 5, 0, 3, 4, 0])


def test_cross_pool_weighs_local_descriptors_by_each_following_map() -> None:
    following = np.zeros((2, 2, 3), np.float32)
    following[0, 0, 0] = 4  # map 0 sees the cell (1, 0) alone
    following[0, 1, 1], following[1, 1, 1] = 2, 3  # map 1: 2 x (2, 5) + 3 x (4, 0)
    expected = [[4, 0], [16, 10], [0, 0]]
    np.testing.assert_allclose(cross_pool(MAPS, following), np.sqrt(np.ravel(expected)), rtol=1e-6)


def test_cross_pool_wants_one_grid() -> None:
    with pytest.raises(ValueError, match="number of cells"):
        cross_pool(MAPS, np.zeros((1, 2, 3), np.float32))
