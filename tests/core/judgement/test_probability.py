"""The curve from decision values to probabilities: bounded, rising, as likely as any, and honest about few outcomes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.linear_model import LogisticRegression

from core.judgement.probability import STRETCH, Curve, fit_curve, moved_curve

SLOPES = st.floats(1e-3, 1e4)
DECISIONS = st.floats(-1e6, 1e6)


def drawn(n: int, curve: Curve, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    decisions = generator.uniform(0, 0.3, n)
    return decisions, generator.random(n) < curve.probabilities(decisions)


@given(SLOPES, st.floats(-50, 50), DECISIONS, DECISIONS)
def test_a_probability_lies_between_0_and_1_and_never_falls(slope: float, intercept: float, a: float, b: float) -> None:
    curve = Curve(slope=slope, intercept=intercept)
    low, high = sorted((a, b))
    assert 0 < curve.probability(low) <= curve.probability(high) < 1


@given(st.floats(1, 100), st.floats(-5, 5), st.floats(0.01, 0.99))
def test_the_decision_value_of_a_probability_has_that_probability(slope: float, intercept: float, p: float) -> None:
    curve = Curve(slope=slope, intercept=intercept)
    assert curve.probability(curve.decision(p)) == pytest.approx(p, abs=1e-9)


def test_the_curve_that_made_the_outcomes_is_found_again() -> None:
    true = Curve(slope=40, intercept=-4)
    made = fit_curve(*drawn(20_000, true))
    assert made.slope == pytest.approx(true.slope, rel=0.05)
    assert made.intercept == pytest.approx(true.intercept, abs=0.2)


def test_it_is_the_logistic_regression_of_others_but_for_the_smoothing() -> None:
    decisions, right = drawn(500, Curve(slope=30, intercept=-3), seed=1)
    made = fit_curve(decisions, right)
    # scikit-learn has no smoothed targets: each outcome stands twice, weighted by its target and by the rest of it.
    positive, negative = right.sum(), (~right).sum()
    targets = np.where(right, (positive + 1) / (positive + 2), 1 / (negative + 2))
    doubled, labels = np.tile(decisions, 2)[:, None], np.repeat([1, 0], len(right))
    other = LogisticRegression(C=1e9, tol=1e-10, max_iter=10_000)
    other.fit(doubled / decisions.std(), labels, np.concatenate([targets, 1 - targets]))
    assert made.slope == pytest.approx(other.coef_[0, 0] / decisions.std(), rel=1e-3)
    assert made.intercept == pytest.approx(other.intercept_[0], rel=1e-3)


def test_outcomes_that_a_threshold_separates_do_not_make_it_sure() -> None:
    made = fit_curve([0.1, 0.2, 0.3, 0.7, 0.8, 0.9], [False] * 3 + [True] * 3)
    assert 0.02 < made.probability(0.1) < 0.3
    assert 0.7 < made.probability(0.9) < 0.98


def test_shares_count_as_repetitions_do() -> None:
    decisions, right = drawn(300, Curve(slope=30, intercept=-3), seed=2)
    thrice = fit_curve(np.concatenate([decisions, decisions[:100]]), np.concatenate([right, right[:100]]))
    weighted = fit_curve(decisions, right, np.where(np.arange(300) < 100, 2.0, 1.0))
    assert weighted.slope == pytest.approx(thrice.slope, rel=0.02)  # the smoothing counts outcomes, not shares


@pytest.mark.parametrize(
    ("decisions", "right", "why"),
    [
        ([0.1, 0.2], [True, True], "right and wrong"),
        ([], [], "right and wrong"),
        ([0.5] * 4, [True, False] * 2, "same"),
        ([0.1, 0.2, 0.8, 0.9], [True, True, False, False], "higher"),
    ],
)
def test_outcomes_that_tell_nothing(decisions: list[float], right: list[bool], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        fit_curve(decisions, right)


def moved(curve: Curve, decisions: np.ndarray, right: np.ndarray, factor: float = 1.0) -> Curve:
    return moved_curve(curve, decisions, np.zeros(len(decisions)), right, np.full(len(decisions), factor))


def test_many_outcomes_move_a_curve_to_their_own() -> None:
    law = Curve(slope=40, intercept=-5)
    decisions, right = drawn(4000, law)
    found = moved(Curve(slope=60, intercept=-4, imagined_slope=6, imagined_intercept=1), decisions, right)
    assert found.slope == pytest.approx(40, rel=0.1) and found.intercept == pytest.approx(-5, abs=0.4)
    assert found.imagined_slope == pytest.approx(found.slope / 10)


def test_outcomes_as_expected_do_not_move_a_curve_and_few_move_it_little() -> None:
    law = Curve(slope=40, intercept=-5)
    decisions, right = drawn(4000, law)
    same = moved(law, decisions, right)
    assert same.slope == pytest.approx(40, rel=0.06) and same.intercept == pytest.approx(-5, abs=0.3)
    none = moved(law, np.empty(0), np.empty(0, np.bool_))
    assert (none.slope, none.intercept) == pytest.approx((40, -5), abs=1e-3)
    one = moved(law, np.array([0.3]), np.array([False]))
    assert one.slope > 40 * np.exp(-3 * STRETCH) and one.probability(0.3) < law.probability(0.3)


@pytest.mark.thorough
@given(st.lists(st.tuples(st.floats(0, 0.5), st.booleans()), max_size=30), st.floats(0.5, 1))
def test_whatever_the_outcomes_a_curve_is_a_curve(outcomes: list[tuple[float, bool]], factor: float) -> None:
    decisions, right = np.array([d for d, _ in outcomes]), np.array([r for _, r in outcomes], np.bool_)
    found = moved(Curve(slope=40, intercept=-5), decisions, right, factor)
    assert found.slope > 0 and np.isfinite(found.intercept)
    if len(outcomes) and not right.any():
        assert found.probability(0.2) <= Curve(slope=40, intercept=-5).probability(0.2) + 1e-3


def test_a_curve_is_not_biased_by_frames_that_were_chosen_by_their_answers() -> None:
    """Of an environment where answers are less often right, only the doubtful ones are labelled."""
    law = Curve(slope=60, intercept=-9)
    decisions, right = drawn(30_000, law)
    doubtful = decisions < 0.16
    found = moved(Curve(slope=60, intercept=-6), decisions[doubtful], right[doubtful])
    where = np.linspace(0, 0.3, 50)
    assert np.abs(found.probabilities(where) - law.probabilities(where)).max() < 0.06
