"""The figures of the benchmark of geometric verification, on candidates whose figures are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.geometry.verification import (
    FORMS,
    SHARES,
    Pictures,
    Task,
    Verified,
    chosen_weight,
    figures_of,
    with_share,
)
from lab.training.validation import Encodings

NOTHING = Pictures(Encodings(np.zeros((0, 1), np.float32), np.zeros((0, 1, 1), np.int8)), [])


def candidates(fitted: bool = True) -> Verified:
    """Two queries with two candidates each: the second's true one is behind, by 0.1, and has half of the keypoints."""
    zeros = np.zeros((2, 2))
    return Verified(
        task=Task("made up", NOTHING, NOTHING, np.zeros((2, 2), np.bool_), 0, fitted),
        reference=np.array([[0, 1], [1, 0]]),
        score=np.array([[0.5, 0.2], [0.4, 0.3]]),
        lead=np.array([0.3, 0.1]),
        matches=zeros,
        inliers=np.array([[10.0, 0.0], [0.0, 50.0]]),
        evidence=zeros,
        spread=zeros,
        share=np.array([[0.1, 0.0], [0.0, 0.5]]),
        true=np.array([[True, False], [False, True]]),
        known=np.array([True, True]),
    )


@pytest.mark.parametrize(
    ("form", "count", "recall"),
    [
        (FORMS["two stages"], 2, 0.5),
        (FORMS["inliers alone"], 2, 1.0),
        (with_share(0.1), 2, 0.5),
        (with_share(0.25), 2, 1.0),
        (with_share(0.25), 1, 0.5),
    ],
)
def test_a_form_orders_the_candidates(form: object, count: int, recall: float) -> None:
    assert figures_of(candidates(), form, count)[0] == recall  # type: ignore[arg-type]


def test_the_weight_is_the_least_that_is_enough_on_the_tasks_to_fit_on() -> None:
    slow = replace(candidates(fitted=False), share=np.zeros((2, 2)))
    assert chosen_weight([candidates(), slow]) == SHARES[1]


def test_queries_without_their_place_do_not_count_in_the_recall() -> None:
    one = replace(candidates(), known=np.array([True, False]), true=np.array([[True, False], [False, False]]))
    assert figures_of(one, FORMS["two stages"])[0] == 1.0
