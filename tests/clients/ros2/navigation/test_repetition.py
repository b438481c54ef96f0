"""The stamps of the transform."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from placerec_ros.odometry import NANOSECONDS
from placerec_ros.repetition import Repetition


def test_it_keeps_the_rate_and_lies_ahead() -> None:
    repetition = Repetition(rate=10.0, tolerance=0.5)
    sent = [repetition.due(number * NANOSECONDS // 100) for number in range(101)]
    stamps = [one for one in sent if one is not None]
    assert len(stamps) == 11
    assert stamps[0] == NANOSECONDS // 2
    assert {after - before for before, after in pairwise(stamps)} == {NANOSECONDS // 10}


@given(st.lists(st.integers(10 * NANOSECONDS, 11 * NANOSECONDS - 1), max_size=50))
def test_stamps_never_go_back(moments: list[int]) -> None:
    repetition = Repetition(rate=20.0, tolerance=0.2)
    stamps = [one for moment in moments if (one := repetition.due(moment)) is not None]
    assert all(before < after for before, after in pairwise(stamps))


def test_a_clock_that_is_set_back_begins_anew() -> None:
    repetition = Repetition(rate=20.0, tolerance=0.0)
    assert repetition.due(100 * NANOSECONDS) is not None
    assert repetition.due(99 * NANOSECONDS + 1) is None, "a message out of order"
    assert repetition.due(50 * NANOSECONDS) == 50 * NANOSECONDS
