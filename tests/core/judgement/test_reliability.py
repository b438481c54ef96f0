"""Intervals, Brier score and calibration error, against figures known otherwise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest
from sklearn.metrics import brier_score_loss

from core.judgement.reliability import brier, reliability, wilson


@given(st.integers(0, 400), st.integers(1, 400))
def test_wilsons_interval_is_that_of_scipy(count: int, of: int) -> None:
    count = min(count, of)
    share = wilson(count, of)
    interval = binomtest(count, of).proportion_ci(0.95, method="wilson")
    assert (share.low, share.high) == pytest.approx((interval.low, interval.high), abs=1e-12)
    assert share.value is not None and 0 <= share.low <= share.value <= share.high <= 1


def test_an_interval_of_the_literature() -> None:
    """Newcombe (Statistics in Medicine 17, 1998), table I: 81 of 263, and 0 of 20."""
    assert (wilson(81, 263).low, wilson(81, 263).high) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert (wilson(0, 20).low, wilson(0, 20).high) == pytest.approx((0, 0.1611), abs=5e-5)


def test_nothing_counted_could_be_anything() -> None:
    share = wilson(0, 0)
    assert (share.value, share.low, share.high) == (None, 0.0, 1.0)
    with pytest.raises(ValueError, match="no share"):
        wilson(3, 2)


def test_outcomes_drawn_from_their_probabilities_are_reliable() -> None:
    generator = np.random.default_rng(0)
    probabilities = generator.random(50_000)
    found = reliability(probabilities, generator.random(50_000) < probabilities)
    assert found.ece < 0.01
    assert found.brier == pytest.approx(1 / 6, abs=0.005)  # the mean of p (1 - p)
    assert found.brier_of_base_rate == pytest.approx(0.25, abs=0.001)
    assert sum(one.right.of for one in found.bins) == found.answers == 50_000


def test_the_calibration_error_of_a_braggart() -> None:
    found = reliability([0.95] * 10 + [0.15] * 10, [True] * 5 + [False] * 5 + [False] * 10)
    assert found.ece == pytest.approx((0.45 + 0.15) / 2)
    assert [(one.low, one.right.count, one.right.of) for one in found.bins] == [(0.1, 0, 10), (0.9, 5, 10)]


def test_the_brier_score_is_that_of_scikit_learn() -> None:
    generator = np.random.default_rng(1)
    probabilities, right = generator.random(100), generator.random(100) < 0.3
    assert brier(probabilities, right) == pytest.approx(brier_score_loss(right, probabilities))


def test_both_ends_have_a_bin() -> None:
    assert [one.low for one in reliability([0.0, 1.0], [False, True]).bins] == [0.0, 0.9]


@pytest.mark.parametrize("probabilities", [[], [1.2], [float("nan")]])
def test_what_is_no_probability(probabilities: list[float]) -> None:
    with pytest.raises(ValueError, match="probabilities"):
        reliability(probabilities, [True] * len(probabilities))
