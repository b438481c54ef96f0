from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lab.evaluation.protocol.outcomes import Outcome, answerable, judge, judge_ranking, matched_scores

ALL = np.arange(4)


def ranking(*scores: float) -> NDArray[np.float32]:
    return np.array(scores, np.float32)


def indices(*values: int) -> NDArray[np.int64]:
    return np.array(values, np.int64)


def test_the_best_true_reference_gives_the_rank() -> None:
    outcome = judge_ranking(ranking(0.1, 0.9, 0.5, 0.7), ALL, indices(0, 2))
    assert (outcome.retrieved, outcome.matched, outcome.rank) == (1, False, 3)
    assert outcome.score == pytest.approx(0.9)


def test_of_equal_scores_the_lower_index_comes_first() -> None:
    scores = ranking(0.5, 0.5, 0.5, 0.2)
    assert judge_ranking(scores, ALL, indices(1)) == Outcome(0, 0.5, False, 2)
    assert judge_ranking(scores, ALL, indices(0)) == Outcome(0, 0.5, True, 1)
    assert judge_ranking(scores, ALL, indices(2, 3)) == Outcome(0, 0.5, False, 3)


def test_indices_stay_those_of_the_full_traverse() -> None:
    retained = indices(2, 5, 9)
    outcome = judge_ranking(ranking(0.1, 0.3, 0.2), retained, indices(5))
    assert (outcome.retrieved, outcome.matched, outcome.rank) == (5, True, 1)
    # The only true reference was left out: a true negative, whatever it retrieves.
    negative = judge_ranking(ranking(0.1, 0.3, 0.2), retained, indices(4))
    assert (negative.retrieved, negative.matched, negative.rank) == (5, False, None)


@pytest.mark.parametrize("scores", [[], [0.1, float("nan")], [float("inf"), 0.0]])
def test_scores_must_be_finite(scores: list[float]) -> None:
    with pytest.raises(ValueError, match="finite"):
        judge_ranking(ranking(*scores), np.arange(len(scores)), indices(0))


def test_a_matrix_is_judged_row_by_row() -> None:
    scores = np.array([[0.1, 0.9], [0.8, 0.2], [0.3, 0.4]], np.float32)
    outcomes = judge(scores, indices(0, 3), [indices(3), indices(3, 5), indices(1)])
    assert [(outcome.retrieved, outcome.rank) for outcome in outcomes] == [(3, 1), (0, 2), (3, None)]
    assert answerable(outcomes) == outcomes[:2]


def test_what_is_left_out_is_not_matched_against() -> None:
    """Query 0 would find itself; without it and its neighbour, 3 is best and right, and 2 is second."""
    scores = np.stack([ranking(1.0, 0.9, 0.2, 0.4), ranking(0.1, 0.2, 0.3, 0.4)])
    excluded = [indices(0, 1), indices()]
    outcomes = judge(scores, ALL, [indices(2), indices(3)], excluded)
    assert [(one.retrieved, one.rank) for one in outcomes] == [(3, 2), (3, 1)]
    assert matched_scores(scores, ALL, excluded)[0].tolist() == [-np.inf, -np.inf, scores[0, 2], scores[0, 3]]
    assert matched_scores(scores, ALL, None) is scores
    with pytest.raises(ValueError, match="at least one score"):
        judge(scores, ALL, [indices(), indices()], [indices(0, 1, 2, 3), indices()])
