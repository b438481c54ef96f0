"""Which looks a place keeps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.learning import LookStatistics, kept
from core.learning.looks import REPEATS
from core.learning.statistics import IDLE


def table(*conditions: int) -> np.ndarray:
    """Looks of the same condition score 0.9 against each other, others 0.2."""
    return np.where(np.equal.outer(conditions, conditions), 0.9, 0.2).astype(np.float32)


def test_looks_that_repeat_others_go() -> None:
    assert kept(table(0, 1, 1, 1), 0.3, 4).tolist() == [0, 1]


def test_the_conditions_are_covered() -> None:
    assert kept(table(0, 1, 1, 2, 0), 0.3, 3).tolist() == [0, 1, 3]


def test_of_two_that_repeat_each_other_the_one_that_helps_more_stays() -> None:
    served = [LookStatistics(), LookStatistics(right=1), LookStatistics(right=7)]
    assert kept(table(0, 1, 1), 0.3, 3, served).tolist() == [0, 2]


def test_looks_that_never_help_or_mislead_go() -> None:
    served = [LookStatistics(passed=99), LookStatistics(passed=IDLE), LookStatistics(wrong=2)]
    assert kept(table(0, 1, 2), 0.3, 3, served).tolist() == [0]


@given(st.integers(1, 6), st.integers(1, 8), st.integers(0, 999))
def test_the_first_stays_and_every_look_that_goes_is_like_one_that_stays(most: int, count: int, seed: int) -> None:
    scores = np.random.default_rng(seed).uniform(0, 1, (count, count)).astype(np.float32)
    found = kept(scores, 0.3, most).tolist()
    alike = np.maximum(scores, scores.T)
    assert found[0] == 0
    assert len(found) <= most
    assert found == sorted(set(found))
    for gone in set(range(count)) - set(found):
        assert len(found) == most or alike[gone, found].max() >= REPEATS * 0.3


def test_looks_that_people_added_stay_and_count() -> None:
    assert kept(table(0, 1, 1, 2), 0.3, 3, fixed=3).tolist() == [0, 1, 2], "there is no room for a further one"
    assert kept(table(0, 1, 1, 2), 0.3, 4, fixed=3).tolist() == [0, 1, 2, 3]
    assert kept(table(0, 1, 2, 1), 0.3, 9, fixed=3).tolist() == [0, 1, 2], "it repeats what a person added"
    assert kept(table(0, 1, 2), 0.3, 2, [LookStatistics(wrong=9)] * 3, fixed=3).tolist() == [0, 1, 2]


def test_a_place_keeps_its_first_look() -> None:
    with pytest.raises(ValueError, match="first"):
        kept(np.zeros((0, 0), np.float32), 0.3)
    with pytest.raises(ValueError, match="first"):
        kept(table(0), 0.3, 0)
