"""R-MAC: its regions, and its vector of a frame small enough to pool by hand."""

from __future__ import annotations

import numpy as np
import pytest

from core.baselines.rmac import extra_regions, regional_vectors, regions, rmac, starts


def test_a_square_has_one_four_and_nine_regions() -> None:
    found = regions(13, 13)
    sides = [rows.stop - rows.start for rows, _ in found]
    assert sides == [13] + 4 * [8] + 9 * [6]
    assert [(rows.start, columns.start) for rows, columns in found[1:5]] == [(0, 0), (0, 5), (5, 0), (5, 5)]
    assert sorted({rows.start for rows, _ in found[5:]}) == [0, 3, 7]


@pytest.mark.parametrize(("height", "width", "more"), [(13, 13, 0), (12, 16, 1), (13, 20, 1), (10, 25, 3), (20, 13, 1)])
def test_the_long_side_has_more_regions(height: int, width: int, more: int) -> None:
    # Of 10 x 25: steps of 15, 7.5 and 5 cells overlap by -50, 25 and 50 %; 50 % is nearest to 40 %.
    assert extra_regions(height, width) == more
    down, across = (
        len({rows.start for rows, _ in regions(height, width)[: 1 + more]}),
        len({columns.start for _, columns in regions(height, width)[: 1 + more]}),
    )
    assert (down, across) == ((1, 1 + more) if width >= height else (1 + more, 1))


def test_all_regions_lie_in_the_maps() -> None:
    for height, width in [(1, 1), (2, 3), (13, 13), (30, 40), (7, 50)]:
        for rows, columns in regions(height, width):
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
