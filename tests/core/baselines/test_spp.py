"""Spatial pyramid pooling by hand."""

from __future__ import annotations

import numpy as np

from core.baselines.spp import bins, spatial_pyramid_pool


def test_windows_overlap_where_cells_do_not_divide() -> None:
    assert bins(4, 2) == [slice(0, 2), slice(2, 4)]
    assert bins(5, 2) == [slice(0, 3), slice(2, 5)]
    assert bins(13, 4) == [slice(0, 4), slice(3, 7), slice(6, 10), slice(9, 13)]


def test_the_pyramid_of_one_map() -> None:
    maps = np.arange(16, dtype=np.float32).reshape(4, 4, 1)
    pooled = spatial_pyramid_pool(maps)
    assert len(pooled) == 1 + 4 + 9 + 16
    np.testing.assert_array_equal(pooled[:5], [15, 5, 7, 13, 15])
    # Windows of level 3 on four cells: 0-1, 1-2, 2-3.
    np.testing.assert_array_equal(pooled[5:14], [5, 6, 7, 9, 10, 11, 13, 14, 15])
    np.testing.assert_array_equal(pooled[14:], np.arange(16))


def test_maps_stand_side_by_side_in_each_window() -> None:
    maps = np.zeros((4, 4, 2), np.float32)
    maps[0, 0], maps[3, 3] = (7, 1), (2, 9)
    pooled = spatial_pyramid_pool(maps).reshape(30, 2)
    np.testing.assert_array_equal(pooled[:5], [[7, 9], [7, 1], [0, 0], [0, 0], [2, 9]])
