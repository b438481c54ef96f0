"""Glances at places are read once, kept within bounds, and zeros where there is nothing to see."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.geometry.keypoints import LENGTH, Keypoints
from core.geometry.matching import GLANCED, glance_at
from core.maps.glances import Glances


def keypoints(row: int) -> Keypoints:
    """Seventy keypoints, by which a row can be told."""
    return Keypoints(640, 480, np.zeros((70, 2), np.uint16), np.full((70, LENGTH), row + 1, np.int8))


class Reads:
    """Reads keypoints of even rows, and knows which rows it was asked for."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def __call__(self, rows: Sequence[int]) -> list[Keypoints | None]:
        self.asked += rows
        return [None if row % 2 else keypoints(row) for row in rows]


def test_a_place_is_read_once_and_one_without_keypoints_shows_nothing() -> None:
    reads = Reads()
    glances = Glances(reads)
    found = glances.at([4, 3, 2])
    assert found.shape == (3, GLANCED, LENGTH) and found.dtype == np.int8
    assert np.array_equal(found[0], glance_at(keypoints(4))) and not found[1].any()
    assert np.array_equal(glances.at([2, 4]), found[[2, 0]])
    assert reads.asked == [4, 3, 2]
    glances.at([3])
    assert reads.asked[-1] == 3, "keypoints may be found later"


def test_those_that_were_not_used_for_the_longest_time_go_first() -> None:
    reads = Reads()
    glances = Glances(reads, most=2)
    glances.at([2, 4])
    glances.at([2])
    glances.at([6])
    reads.asked.clear()
    assert glances.at([2, 6]).any() and not reads.asked
    glances.at([4])
    assert reads.asked == [4]


def test_no_rows_are_no_glances() -> None:
    assert Glances(Reads()).at([]).shape == (0, GLANCED, LENGTH)
