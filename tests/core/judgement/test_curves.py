"""Curves and areas by hand, and against scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import auc, precision_recall_curve, roc_auc_score

from core.judgement.curves import auc_pr, auc_roc, pr_curve, roc_curve

# Few different values, so that ties are common.
LABELLED = st.lists(st.tuples(st.integers(-3, 3).map(lambda n: n / 4), st.booleans()), min_size=1, max_size=40)


def test_auc_pr_by_hand() -> None:
    # Best first: right, wrong, right.  (recall, precision): (0, 1), (1/2, 1), (1/2, 1/2), (1, 2/3).
    # Trapezoids: 1/2 · 1 + 0 + 1/2 · (1/2 + 2/3) / 2 = 0.5 + 7/24.
    assert auc_pr([0.9, 0.5, 0.1], [True, False, True]) == pytest.approx(0.5 + 7 / 24)
    # Average precision would be 1/2 + 1/2 · 2/3 = 5/6; the trapezoid lies below it here.
    assert auc_pr([0.9, 0.5, 0.1], [True, False, True]) < 5 / 6


def test_equal_scores_are_accepted_together() -> None:
    # One point for both: (0, 1), (1, 1/2).
    assert auc_pr([0.4, 0.4], [True, False]) == pytest.approx(0.75)
    assert auc_pr([0.4, 0.4], [False, True]) == pytest.approx(0.75)


def test_auc_pr_with_one_class() -> None:
    assert auc_pr([0.4, 0.9, 0.1], [True, True, True]) == 1.0
    assert auc_pr([0.4, 0.9, 0.1], [False, False, False]) == 0.0
    assert auc_pr([0.4], [True]) == 1.0


@given(LABELLED)
def test_auc_pr_is_that_of_scikit_learn(labelled: list[tuple[float, bool]]) -> None:
    scores, matched = zip(*labelled, strict=True)
    if any(matched):  # without one the library's curve is made up
        precision, recall, _ = precision_recall_curve(matched, scores)
        assert auc_pr(scores, matched) == pytest.approx(auc(recall, precision))


def test_auc_roc_by_hand() -> None:
    # Positives 0.9, 0.5, 0.2 against negatives 0.5, 0.1: 2 + 1.5 + 1 of 6 pairs.
    assert auc_roc([0.9, 0.5, 0.5, 0.1, 0.2], [True, True, False, False, True]) == pytest.approx(4.5 / 6)


def test_auc_roc_needs_both_kinds() -> None:
    assert auc_roc([0.3, 0.4], [True, True]) is None
    assert auc_roc([0.3, 0.4], [False, False]) is None


@pytest.mark.thorough
@given(LABELLED)
def test_auc_roc_is_that_of_scikit_learn(labelled: list[tuple[float, bool]]) -> None:
    scores, positive = zip(*labelled, strict=True)
    if len(set(positive)) == 2:
        assert auc_roc(scores, positive) == pytest.approx(roc_auc_score(positive, scores))


def test_the_points_of_both_curves_by_hand() -> None:
    # Right, wrong, right, and one more wrong.
    curve = pr_curve([0.9, 0.8, 0.7, 0.6], [True, False, True, False])
    assert curve is not None
    assert curve[0].tolist() == [0, 0.5, 0.5, 1, 1]
    assert curve[1] == pytest.approx([1, 1, 1 / 2, 2 / 3, 2 / 4])
    curve = roc_curve([0.9, 0.8, 0.8, 0.6], [True, False, True, False])
    assert curve is not None
    np.testing.assert_allclose(curve, [[0, 0, 0.5, 1], [0, 0.5, 1, 1]])


def test_without_both_kinds_there_is_no_curve() -> None:
    assert pr_curve([0.5, 0.4], [False, False]) is None
    assert roc_curve([0.5, 0.4], [True, True]) is None
    assert roc_curve([0.5, 0.4], [False, False]) is None
