from __future__ import annotations

import pytest

from lab.evaluation.protocol.outcomes import Outcome
from lab.evaluation.protocol.thresholds import (
    Counts,
    best_wrong_score,
    count_after,
    count_before,
    mean_of_negatives,
    thresholdings,
)


def counts(tp: int, fp: int, fn: int, tn: int) -> Counts:
    return Counts(true_positives=tp, false_positives=fp, false_negatives=fn, true_negatives=tn)


# Five queries with a true reference, three right and two wrong, and four new places.
RIGHT = [Outcome(0, score, True, 1) for score in (0.9, 0.6, 0.3)]
WRONG = [Outcome(0, score, False, 2) for score in (0.7, 0.2)]
NEW = [Outcome(0, score, False, None) for score in (0.8, 0.5, 0.4, 0.3)]
OUTCOMES = [*RIGHT, *WRONG, *NEW]


def test_before_a_threshold_new_places_stand_apart() -> None:
    assert count_before(OUTCOMES) == counts(3, 2, 0, 4)


def test_the_thesis_threshold_by_hand() -> None:
    threshold = mean_of_negatives(OUTCOMES)
    assert threshold == pytest.approx(0.5)
    # 0.5 itself is not above it. Accepted: right 0.9, 0.6; wrong 0.7; new 0.8. Rejected: right 0.3, wrong 0.2; new 3.
    assert count_after(OUTCOMES, 0.5) == counts(2, 2, 2, 3)


def test_counts_always_add_up() -> None:
    for threshold in (-1.0, 0.2, 0.35, 0.9, 2.0):
        after = count_after(OUTCOMES, threshold)
        assert sum(after.model_dump().values()) == len(OUTCOMES)
    assert count_after(OUTCOMES, -1.0) == counts(3, 6, 0, 0)
    assert count_after(OUTCOMES, 2.0) == counts(0, 0, 5, 4)


def test_above_the_best_wrong_match_all_is_right() -> None:
    assert best_wrong_score(OUTCOMES) == 0.8
    assert count_after(OUTCOMES, 0.8) == counts(1, 0, 4, 4)


def test_what_the_outcomes_do_not_define_is_left_out() -> None:
    assert [one.rule for one in thresholdings(OUTCOMES)] == ["mean_of_negatives", "full_precision"]
    assert [one.rule for one in thresholdings([*RIGHT, *WRONG])] == ["full_precision"]
    assert thresholdings(RIGHT) == []
    one = thresholdings(OUTCOMES)[0]
    assert (one.before, one.after) == (counts(3, 2, 0, 4), counts(2, 2, 2, 3))
