"""The background of a query: what a small map is taken to hold besides its places."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from core.judgement.background import FULL, TOP_PLACES, Background, Environment, background, unrelated

PRIOR = Environment(mean=0.13, deviation=0.03, mean_weight=0.5, deviation_weight=6)
NOTHING = np.empty(0, np.float32)


def test_a_further_place_is_expected_as_the_conjugate_prior_says() -> None:
    """By numerical integration of the prior times the likelihood."""
    scores = np.array([0.2, 0.22, 0.17])
    mean, spread = np.meshgrid(np.linspace(0, 0.4, 801), np.linspace(0.004, 0.25, 1200), indexing="ij")
    variance = spread**2
    freedom = PRIOR.deviation_weight
    log = -(freedom / 2 + 1) * np.log(variance) - freedom * PRIOR.deviation**2 / (2 * variance)
    log += -0.5 * np.log(variance) - PRIOR.mean_weight * (mean - PRIOR.mean) ** 2 / (2 * variance)
    for score in scores:
        log += -0.5 * np.log(variance) - (score - mean) ** 2 / (2 * variance)
    weight = np.exp(log - log.max()) * spread  # the grid is even in the deviation, not in the variance
    weight /= weight.sum()
    expected = float((weight * mean).sum())
    found, deviation = PRIOR.further(scores)
    assert found == pytest.approx(expected, abs=1e-4)
    # The module's scale is that of a t distribution, whose variance is larger by nu / (nu - 2).
    nu = freedom + len(scores)
    whole = float((weight * (variance + (mean - expected) ** 2)).sum())
    assert deviation**2 * nu / (nu - 2) == pytest.approx(whole, rel=0.01)


def test_without_a_place_the_prior_stands_alone() -> None:
    mean, deviation = PRIOR.further(np.empty(0))
    assert (mean, deviation) == pytest.approx((0.13, 0.03 * np.sqrt(1 + 1 / 0.5)))


def test_a_map_without_other_places_is_all_imagined_and_a_full_one_not_at_all() -> None:
    empty = background(NOTHING, NOTHING, 0, PRIOR)
    assert len(empty.scores) == FULL and empty.imagined == 1
    assert empty.top > PRIOR.mean + PRIOR.deviation
    scores = np.linspace(0.3, 0.1, FULL, dtype=np.float32)
    full = background(scores, scores, FULL, PRIOR)
    assert full.imagined == 0
    np.testing.assert_array_equal(full.scores, scores.astype(np.float64))


def test_with_every_place_less_is_imagined_and_the_map_counts_more() -> None:
    random = np.random.default_rng(0)
    shares, distances = [], []
    for count in (1, 5, 20, 50):
        scores = np.sort(random.normal(0.3, 0.02, count))[::-1]
        found = background(scores, scores, count, PRIOR)
        shares.append(found.imagined)
        distances.append(abs(PRIOR.further(scores)[0] - 0.3))
    assert shares == sorted(shares, reverse=True)
    assert distances[-1] < 0.01 < distances[0]


def test_places_that_overlap_with_the_best_match_teach_nothing_but_are_there() -> None:
    beside = np.array([0.4, 0.38], np.float32)
    found = background(beside, NOTHING, 2, PRIOR)
    assert PRIOR.further(np.empty(0))[0] == pytest.approx(float(np.sort(found.scores)[: FULL - 2].mean()), abs=1e-3)
    assert found.scores[:2].tolist() == pytest.approx([0.4, 0.38])
    assert background(beside, beside, 2, PRIOR).top > found.top


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0, 0.5))
def test_a_higher_score_never_stands_out_less(a: float, more: float, top: float) -> None:
    behind = Background(np.full(TOP_PLACES, top), 0.0)
    assert behind.decision(a) <= behind.decision(a + more) + 1e-12


def test_the_decision_value_is_the_geometric_mean_and_negative_behind_the_background() -> None:
    behind = Background(np.array([0.3, 0.2, 0.2, 0.2, 0.1, 0.0]), 0.0)
    assert behind.top == pytest.approx(0.2)
    assert behind.decision(0.5) == pytest.approx(np.sqrt(0.5 * 0.3))
    assert behind.decision(0.2) == pytest.approx(0, abs=1e-7)
    assert behind.decision(0.1) == pytest.approx(-np.sqrt(0.2 * 0.1))


def test_calibrations_of_the_first_release_imagine_what_they_did() -> None:
    found = unrelated(np.array([0.3], np.float32), 0.07, 0.01)
    assert found.imagined == 0 and len(found.scores) == TOP_PLACES
    assert found.scores[1:].mean() == pytest.approx(0.07)


@pytest.mark.parametrize("field", ["deviation", "mean_weight", "deviation_weight"])
def test_a_prior_without_weight_or_spread_is_refused(field: str) -> None:
    with pytest.raises(ValidationError, match=field):
        Environment.model_validate(PRIOR.model_dump() | {field: 0})
