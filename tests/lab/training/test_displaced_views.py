"""Pairs of displaced views, and which of their cells show the same spot."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from lab.training.views.displaced_views import COLUMNS, STRIDE, answering, displaced, displaced_views


def test_cells_answer_each_other_where_a_warp_moves_them() -> None:
    rows, columns = np.divmod(np.arange(COLUMNS**2), COLUMNS)
    shift = np.array([[1, 0, 2 * STRIDE], [0, 1, -STRIDE], [0, 0, 1]])
    answers = answering(shift)
    seen = (columns < COLUMNS - 2) & (rows > 0)
    np.testing.assert_array_equal(answers[:, 0], np.flatnonzero(seen))
    np.testing.assert_array_equal(answers[:, 1], answers[:, 0] + 2 - COLUMNS)
    assert len(answering(np.array([[1, 0, 1000.0], [0, 1, 0], [0, 0, 1]]))) == 0


def test_answering_cells_of_two_views_show_the_same_colours() -> None:
    generator = np.random.default_rng(0)
    coarse = generator.integers(0, 256, (6, 8, 3), np.uint8)
    picture = np.asarray(cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC), np.uint8)
    for _ in range(5):
        first, second, answers = displaced([picture], 227, generator)
        assert first.shape == second.shape == (227, 227, 3)
        assert len(answers) > COLUMNS**2 / 3
        inner = (view[9:217, 9:217] for view in (first, second))
        grids = [cv2.resize(view, (COLUMNS, COLUMNS), interpolation=cv2.INTER_AREA) for view in inner]
        here, there = (grid.reshape(-1, 3).astype(float) for grid in grids)
        apart = np.abs(here[answers[:, 0]] - there[answers[:, 1]]).mean()
        shuffled = np.abs(here[answers[:, 0]] - there[generator.permutation(answers[:, 1])]).mean()
        assert apart < shuffled / 3


def test_views_are_drawn_repeatably_and_those_of_cameras_are_day_and_night(photographs: Path) -> None:
    made, again = (list(displaced_views(photographs, 64, 60, seed=4)) for _ in "ab")
    for one, other in zip(made, again, strict=True):
        np.testing.assert_array_equal(one.second, other.second)
    kinds = [pair.displacement.kind for pair in made]
    assert 0 < kinds.count("cameras") < 20 and kinds.count("displaced") + kinds.count("cameras") == 60
    cameras = [pair.displacement.camera for pair in made if pair.displacement.kind == "cameras"]
    assert set(cameras) <= {"b", "c"}
    assert len({pair.displacement.photograph for pair in made}) > 20
