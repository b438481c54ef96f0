"""How looks serve, by later runs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from core.belief import OdometryPose
from core.learning import LookStatistics, RunFrame, lesson_of, services
from core.learning.statistics import IDLE
from tests.core.learning.runs import covered, except_at, recognized, walked, way

GRAPH = way(60)


def test_a_look_that_wins_frames_of_another_place_is_found_out() -> None:
    """Row 50 wins the frame at row 20."""

    def misled(_row: int, pose: OdometryPose) -> RunFrame:
        return recognized(50, pose)

    frames = walked(range(40), except_at([20], misled))
    found = services(lesson_of(frames, GRAPH), frames, GRAPH, {30: [30, 99]})
    assert found[50] == LookStatistics(wrong=1)
    assert found[25] == LookStatistics(right=1)
    assert found[99] == LookStatistics(passed=1)
    assert sum(one.wrong for one in found.values()) == 1


def test_frames_that_do_not_count_say_nothing() -> None:
    frames = walked(range(40), except_at([20], lambda _row, pose: covered(pose)))
    frames[25] = replace(frames[25], sight="constant")
    found = services(lesson_of(frames, GRAPH), frames, GRAPH)
    assert 20 not in found
    assert 25 not in found


def test_a_run_that_teaches_nothing_says_nothing() -> None:
    frames = walked(range(5), except_at([]))
    assert services(lesson_of(frames, GRAPH), frames, GRAPH) == {}


@pytest.mark.parametrize(
    ("right", "wrong", "misleads"), [(0, 1, False), (0, 2, True), (5, 2, True), (30, 2, False), (30, 5, True)]
)
def test_a_look_is_withdrawn_after_more_than_few_wrong_frames(right: int, wrong: int, misleads: bool) -> None:
    assert LookStatistics(right, wrong).misleads is misleads


def test_a_look_that_never_helps_is_idle() -> None:
    assert LookStatistics(passed=IDLE).idle
    assert not LookStatistics(right=1, passed=IDLE).idle
    assert LookStatistics(1, 2, 3) + LookStatistics(1, 0, 2) == LookStatistics(2, 2, 5)
