"""The way of the odometry, laid onto the map by anchors."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.learning import RunFrame, Trail
from core.learning.anchors import Anchors, Way, pace_of
from tests.core.learning.runs import except_at, heading_at, recognized, walked, way

GRAPH = way(60)


def laid(frames: list[RunFrame], anchors: list[int]) -> Way:
    rows = [frames[number].row for number in anchors]
    known = Anchors(np.array(anchors, np.int64), np.array(rows, np.int64), np.empty(0, np.int64))
    return Way(Trail.of(frames), known, GRAPH)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 1000), st.integers(4, 40))
def test_a_frame_is_put_at_its_place_wherever_odometry_began(seed: int, number: int) -> None:
    frames = walked(range(50), except_at([number]), drift=0.03, seed=seed)
    found = laid(frames, [number - 3, number - 2, number + 2, number + 3])
    fit = found.fit(number)
    assert fit is not None
    assert (fit.before, fit.after) == (number - 2, number + 2)
    assert found.distance(fit, number) < 1
    assert found.distance(fit, number + 4) > 5
    assert found.turned(fit, number) < math.radians(10)


def test_one_anchor_that_is_mistaken_is_outvoted() -> None:
    frames = walked(range(50), except_at([20]), drift=0.0)
    frames[22] = recognized(40, frames[22].pose or pytest.fail("odometry"))
    way_ = laid(frames, [17, 18, 19, 21, 22, 23])
    fit = way_.fit(20)
    assert fit is not None
    assert way_.distance(fit, 20) < 0.5


def test_anchors_that_contradict_one_another_say_nothing() -> None:
    frames = walked(range(50), except_at([20]), drift=0.0)
    for number in (21, 22, 23):
        frames[number] = recognized(number + 20, frames[number].pose or pytest.fail("odometry"))
    assert laid(frames, [17, 18, 19, 21, 22, 23]).fit(20) is None


@pytest.mark.parametrize("anchors", [[17, 18, 19], [21, 22, 23], [19, 21], []])
def test_anchors_on_one_side_or_too_few_say_nothing(anchors: list[int]) -> None:
    assert laid(walked(range(50), except_at([20])), anchors).fit(20) is None


def test_a_robot_that_stood_is_turned_by_the_headings_alone() -> None:
    """All anchors are at one spot, so that their positions say nothing about a turn."""
    frames = walked([20] * 9, except_at([]), drift=0.0)
    fit = laid(frames, [0, 1, 7, 8]).fit(4)
    assert fit is not None
    assert math.remainder(fit.heading - heading_at(40), 2 * math.pi) == pytest.approx(0, abs=0.2)


def test_the_pace_along_a_sequence_is_learnt_from_recognized_frames() -> None:
    graph = way(60, posed=False)
    assert pace_of(Trail.of(walked(range(50), except_at([]))), graph) == pytest.approx(0.5, rel=0.05)
    assert pace_of(Trail.of(walked(range(50), except_at(range(50)))), graph) is None
