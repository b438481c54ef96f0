from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.evaluation.protocol.figures import (
    ALL_RIGHT,
    NO_NEGATIVES,
    NO_POSITIVES,
    NONE_RIGHT,
    extended_precision,
    one_class,
    recall_at_full_precision,
    recall_at_k,
    summarize,
)
from lab.evaluation.protocol.outcomes import Outcome

# Few different values, so that ties are common.
LABELLED = st.lists(st.tuples(st.integers(-3, 3).map(lambda n: n / 4), st.booleans()), min_size=1, max_size=40)


def test_recall_leaves_true_negatives_out() -> None:
    ranks = [1, 2, 6, 11, None, None]
    outcomes = [Outcome(0, 0.5, rank == 1, rank) for rank in ranks]
    assert recall_at_k(outcomes, 1) == 1 / 4
    assert recall_at_k(outcomes, 5) == 2 / 4
    assert recall_at_k(outcomes, 10) == 3 / 4
    assert recall_at_k(outcomes[4:], 1) is None


def test_recall_at_full_precision_is_strict() -> None:
    right = [Outcome(0, score, True, 1) for score in (0.9, 0.8, 0.6, 0.6)]
    wrong = Outcome(0, 0.6, False, 2)
    assert recall_at_full_precision([*right, wrong]) == 2 / 5  # those at 0.6 do not score above it
    assert recall_at_full_precision(right) == 1.0
    assert recall_at_full_precision([wrong]) == 0.0


def test_a_true_negative_limits_recall_at_full_precision() -> None:
    right = [Outcome(0, score, True, 1) for score in (0.9, 0.7)]
    negative = Outcome(0, 0.8, False, None)
    assert recall_at_full_precision([*right, negative]) == 1 / 2  # not of three: it has no true reference
    assert recall_at_full_precision([negative]) is None


def right(score: float) -> Outcome:
    return Outcome(0, score, True, 1)


def wrong(score: float, rank: int | None = 2) -> Outcome:
    return Outcome(0, score, False, rank)


def test_one_class_has_a_word() -> None:
    assert one_class([True, True]) == "all right"
    assert one_class([False]) == "none right"
    assert one_class([True, False]) is None


def test_extended_precision_by_hand() -> None:
    # The best two are right: P_R0 = 1; two of four queries score above the best wrong match: (1 + 2/4) / 2.
    assert extended_precision([right(0.9), right(0.8), wrong(0.7), right(0.6)]) == pytest.approx(0.75)
    # Two wrong matches score best: the first right one comes with a precision of 1/3; R_P100 is 0.
    assert extended_precision([wrong(0.9), wrong(0.8), right(0.7), right(0.6)]) == pytest.approx(1 / 6)
    # A tie of a right and a wrong one at the top: P_R0 = 1/2.
    assert extended_precision([wrong(0.9), right(0.9)]) == pytest.approx(0.25)
    assert extended_precision([right(0.9), right(0.1)]) == 1.0
    assert extended_precision([wrong(0.9)]) == 0.0
    assert extended_precision([wrong(0.9, None)]) is None


@given(LABELLED)
def test_extended_precision_is_over_a_half_only_without_a_confident_mistake(labelled: list[tuple[float, bool]]) -> None:
    outcomes = [right(score) if matched else wrong(score) for score, matched in labelled]
    value = extended_precision(outcomes)
    best_right = max((score for score, matched in labelled if matched), default=-1.0)
    best_wrong = max((score for score, matched in labelled if not matched), default=-1.0)
    assert value is not None and 0 <= value <= 1
    assert (value > 0.5) == (best_right > best_wrong)


def test_a_summary_has_every_figure_and_says_why_one_is_missing() -> None:
    outcomes = [right(0.9), wrong(0.5), wrong(0.7, None)]
    figures = summarize(
        "made@0", outcomes, 7, {"match": 0.5, "hog": 3.0}, describe_milliseconds=4.0, bytes_per_place=12, trained_on="x"
    )
    assert (figures.encoder, figures.queries, figures.references, figures.negatives, figures.right) == (
        "made@0",
        3,
        7,
        1,
        1,
    )
    assert figures.recall_at == {"1": 0.5, "5": 1.0, "10": 1.0}
    assert figures.auc_roc == 0.5  # 0.9 above 0.7, 0.5 below
    assert figures.milliseconds == {"forward": None, "regions": None, "vlad": None, "match": 0.5, "hog": 3.0}
    assert (figures.describe_milliseconds, figures.bytes_per_place, figures.trained_on) == (4.0, 12, "x")
    assert {one.rule for one in figures.thresholds} == {"mean_of_negatives", "full_precision"}
    assert figures.notes == {}

    all_right = summarize("made@0", [right(0.9)], 1, {})
    assert all_right.notes == {"auc_pr": ALL_RIGHT, "auc_roc": NO_NEGATIVES}
    assert (all_right.auc_pr, all_right.one_class) == (1.0, "all right")

    none = summarize("made@0", [wrong(0.9, None)], 1, {})
    assert (none.auc_pr, none.one_class, none.auc_roc, none.extended_precision) == (0.0, "none right", None, None)
    assert none.notes["auc_pr"] == NONE_RIGHT
    assert none.notes["recall_at"] == none.notes["auc_roc"] == NO_POSITIVES
