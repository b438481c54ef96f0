"""Gaps are found where a step is out of the ordinary, and nowhere else."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from core.places import METRIC, NO_POSE, NO_TIME, Whereabouts
from core.upkeep.coverage import backward_steps, distances, durations, long_steps, unlike_steps


def along(x: list[float], kinds: list[int] | None = None, seconds: list[float | None] | None = None) -> Whereabouts:
    position = np.zeros((len(x), 3))
    position[:, 0] = x
    times = [NO_TIME if s is None else int(s * 1e6) for s in (seconds or [None] * len(x))]
    return Whereabouts(
        np.array(kinds or [METRIC] * len(x), np.int8),
        position,
        np.zeros(len(x), np.int32),
        np.arange(len(x)),
        timestamp=np.array(times, np.int64),
    )


def test_a_jump_is_a_gap() -> None:
    (gap,) = long_steps(distances(along([0, 1, 2, 3, 4, 14, 15, 16, 17])), "distance")
    assert (gap.before, gap.value, gap.median, gap.severity) == (4, 10.0, 1.0, 10.0)


def test_steps_without_poses_are_not_known() -> None:
    steps = distances(along([0, 1, 2, 3], [METRIC, NO_POSE, METRIC, METRIC]))
    assert np.isnan(steps[:2]).all() and steps[2] == 1
    assert long_steps(steps, "distance") == [], "too few are known"


def test_time_is_held_against_the_sequence_too() -> None:
    spent = durations(along([0.0] * 9, seconds=[0, 1, 2, 3, 4, 5, 6, 66, 67]))
    (gap,) = long_steps(spent, "time")
    assert (gap.before, gap.value) == (6, 60.0)
    assert backward_steps(durations(along([0.0] * 3, seconds=[5, 1, None]))) == 1


def test_frames_that_look_unlike_are_a_gap() -> None:
    (gap,) = unlike_steps(np.array([0.4, 0.42, 0.41, 0.05, 0.4, 0.39, np.nan]))
    assert gap.before == 3 and gap.measure == "similarity" and gap.severity > 7


@given(st.lists(st.floats(0.5, 1.4), min_size=1, max_size=40))
def test_an_even_pace_has_no_gap(steps: list[float]) -> None:
    assert long_steps(np.array(steps), "distance") == []
    assert unlike_steps(np.array(steps)) == []


@given(st.lists(st.floats(0, 100, width=32), max_size=40), st.floats(0.125, 8, width=32))
def test_the_unit_does_not_matter(steps: list[float], unit: float) -> None:
    power = 2.0 ** round(np.log2(unit))  # exact in floating point
    one, other = (long_steps(np.array(steps) * scale, "distance") for scale in (1.0, power))
    assert [gap.before for gap in one] == [gap.before for gap in other]


def test_a_robot_that_stood_still_most_of_the_time() -> None:
    assert long_steps(np.array([0.0, 0, 0, 0, 0, 0, 5]), "distance") == []
