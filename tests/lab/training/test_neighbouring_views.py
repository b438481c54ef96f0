"""Pairs of neighbouring frames, and which of their cells a match of keypoints joins."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from core.geometry.verification import Verification
from lab.training.views.displaced_views import COLUMNS, FIRST_CELL, STRIDE
from lab.training.views.neighbouring_views import matched_cells, neighbouring_views
from tests.service.scenes import scene


def test_a_match_joins_the_cells_that_it_lies_in() -> None:
    def share(row: float, column: float) -> tuple[float, float]:
        return (FIRST_CELL + STRIDE * column) / 227, (FIRST_CELL + STRIDE * row) / 227

    first = np.array([share(2, 3), share(2.3, 3), share(5, 5), share(0, 12.8), share(7, 7)])
    second = np.array([share(4, 6), share(2, 3), share(2, 9), share(5, 4), share(0, 0)])
    # The second keypoint is in the same cell as the first, but farther from its middle; the fourth's cell is no more
    # in the frame; the fifth match fits no geometry.
    matches = np.array([[0, 2], [1, 0], [2, 1], [3, 3], [4, 4]])
    inliers = np.array([True, True, True, True, False])
    found = Verification((5, 5), matches, inliers, 20.0, 0.1)
    cells = {(2 * COLUMNS + 3, 2 * COLUMNS + 3), (5 * COLUMNS + 5, 4 * COLUMNS + 6)}
    assert {tuple(one) for one in matched_cells(found, first, second, 227).tolist()} == cells
    none = Verification((5, 5), matches, ~inliers & False, 0.0, 0.0)
    assert matched_cells(none, first, second, 227).shape == (0, 2)


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk of six frames along one picture, and photographs that belong to none."""
    folder = tmp_path_factory.mktemp("walks")
    picture = np.hstack([scene(number) for number in (1, 2)])
    for source in ("tower/floor1/a_", "roads/a_"):
        for number in range(6):
            path = folder / f"{source}{2 * number:06}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), picture[:, 10 * number : 10 * number + scene(1).shape[1]])
    return folder


@pytest.mark.thorough
def test_neighbours_are_drawn_repeatably_from_walks(walks: Path) -> None:
    made, again = (list(neighbouring_views(walks, 227, 4, seed=1)) for _ in "ab")
    assert made and len(made) == len(again)
    for one, other in zip(made, again, strict=True):
        np.testing.assert_array_equal(one.second, other.second)
        np.testing.assert_array_equal(one.displacement.answers, other.displacement.answers)
        assert one.displacement.kind == "neighbours" and one.displacement.camera == ""
        assert 6 <= one.displacement.photograph < 12  # in order of names after those of roads
        first, second = one.displacement.answers.T
        assert len(np.unique(first)) == len(first) and second.max() < COLUMNS**2


def test_without_walks_there_are_no_neighbours(photographs: Path) -> None:
    assert list(neighbouring_views(photographs, 227, 3, seed=1)) == []
