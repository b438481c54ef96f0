"""Pooling by hand on activations that are small enough, and the pooled systems on the packaged network."""

from __future__ import annotations

import numpy as np
import pytest

from core.method.catalogue import EncoderCatalogue
from core.method.equations import power
from lab.baselines.pooling import (
    PooledSystem,
    bins,
    cross_pool,
    extra_regions,
    flatten,
    max_pool,
    regional_vectors,
    rmac,
    spatial_pyramid_pool,
    square_regions,
    starts,
    sum_pool,
)
from lab.baselines.registry import build
from lab.baselines.system import stack, unit

MAPS = np.array([[[1, 0], [2, 5]], [[0, 3], [4, 0]]], np.float32)  # two rows, two columns, two maps


def test_sum_pool() -> None:
    np.testing.assert_array_equal(sum_pool(MAPS), [7, 8])


def test_max_pool() -> None:
    np.testing.assert_array_equal(max_pool(MAPS), [4, 5])


def test_flatten() -> None:
    np.testing.assert_array_equal(flatten(MAPS), [1, 0, 2, 5, 0, 3, 4, 0])


def test_cross_pool_weighs_local_descriptors_by_each_following_map() -> None:
    following = np.zeros((2, 2, 3), np.float32)
    following[0, 0, 0] = 4  # map 0 sees the cell (1, 0) alone
    following[0, 1, 1], following[1, 1, 1] = 2, 3  # map 1: 2 x (2, 5) + 3 x (4, 0)
    expected = [[4, 0], [16, 10], [0, 0]]
    np.testing.assert_allclose(cross_pool(MAPS, following), np.sqrt(np.ravel(expected)), rtol=1e-6)


def test_cross_pool_wants_one_grid() -> None:
    with pytest.raises(ValueError, match="number of cells"):
        cross_pool(MAPS, np.zeros((1, 2, 3), np.float32))


# Spatial pyramid


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


# R-MAC


def test_a_square_has_one_four_and_nine_regions() -> None:
    found = square_regions(13, 13)
    sides = [rows.stop - rows.start for rows, _ in found]
    assert sides == [13] + 4 * [8] + 9 * [6]
    assert [(rows.start, columns.start) for rows, columns in found[1:5]] == [(0, 0), (0, 5), (5, 0), (5, 5)]
    assert sorted({rows.start for rows, _ in found[5:]}) == [0, 3, 7]


@pytest.mark.parametrize(("height", "width", "more"), [(13, 13, 0), (12, 16, 1), (13, 20, 1), (10, 25, 3), (20, 13, 1)])
def test_the_long_side_has_more_regions(height: int, width: int, more: int) -> None:
    # Of 10 x 25: steps of 15, 7.5 and 5 cells overlap by -50, 25 and 50 %; 50 % is nearest to 40 %.
    assert extra_regions(height, width) == more
    down, across = (
        len({rows.start for rows, _ in square_regions(height, width)[: 1 + more]}),
        len({columns.start for _, columns in square_regions(height, width)[: 1 + more]}),
    )
    assert (down, across) == ((1, 1 + more) if width >= height else (1 + more, 1))


def test_all_regions_lie_in_the_maps() -> None:
    for height, width in [(1, 1), (2, 3), (13, 13), (30, 40), (7, 50)]:
        for rows, columns in square_regions(height, width):
            assert 0 <= rows.start < rows.stop <= height
            assert 0 <= columns.start < columns.stop <= width


def test_starts_are_even() -> None:
    assert starts(13, 6, 3) == [0, 3, 7]
    assert starts(5, 5, 1) == [0]


def test_the_vector_of_two_maps_by_hand() -> None:
    maps = np.array([[[9, 0], [0, 0]], [[0, 0], [0, 16]]], np.float32)
    # One region of 2 x 2, four of one cell, nine of one cell that begin at 0, 0 and 1.
    whole, first, last = np.array([3, 4]) / 5, np.array([1, 0]), np.array([0, 1])  # square roots, unit length
    vectors = regional_vectors(maps)
    np.testing.assert_allclose(vectors[0], whole, rtol=1e-6)
    np.testing.assert_allclose(vectors[1:5], np.stack([first, 0 * first, 0 * last, last]), rtol=1e-6)
    np.testing.assert_allclose(rmac(maps), whole + 1 * first + 1 * last + 4 * first + 1 * last, rtol=1e-6)


# The systems


LENGTHS = {
    "sum-pool": 384,
    "max-pool": 384,
    "cross-pool": 384 * 384,
    "whole": 13 * 13 * 384,
    "spp": 30 * 384,
    "rmac": 384,
}


def test_unit_and_power() -> None:
    vectors = np.array([[3, -4], [0, 0]], np.float32)
    np.testing.assert_allclose(unit(vectors), np.array([[0.6, -0.8], [0, 0]]), rtol=1e-6)
    np.testing.assert_allclose(power(np.array([4, -9, 0], np.float32), 0.5), [2, -3, 0], rtol=1e-6)


@pytest.mark.parametrize("name", LENGTHS)
def test_pooled_systems_pool_the_networks_own_maps(name: str) -> None:
    system = build(name, models=EncoderCatalogue())
    assert isinstance(system, PooledSystem)
    frame = np.random.default_rng(1).integers(0, 255, (60, 80, 3)).astype(np.uint8)
    described = system.describe(frame)
    vector = stack([described])[0]
    pooled = system.pool(*system.extractor.activations([frame])[0])
    np.testing.assert_allclose(vector, pooled / np.linalg.norm(pooled), rtol=1e-4, atol=1e-7)
    assert vector.shape == (LENGTHS[name],) and vector.dtype == np.float32
    assert described.nbytes == 4 * LENGTHS[name]
    assert set(described.milliseconds) == {"forward", "pool"}

    blank = system.describe(np.full((60, 80, 3), 7, np.uint8))
    scores = system.index([described, blank]).score([described])
    np.testing.assert_allclose(scores, [[1, 0]], atol=1e-5)


def test_the_identity_speaks_of_constants_and_weights() -> None:
    identities = {build(name, models=EncoderCatalogue()).identity for name in LENGTHS}
    assert len(identities) == len(LENGTHS)
    assert build("spp", models=EncoderCatalogue()).identity in identities
