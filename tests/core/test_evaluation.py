import csv
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from sklearn.metrics import auc, precision_recall_curve, roc_auc_score

from core.encoder import Encoding
from core.evaluation import (
    Outcome,
    auc_pr,
    auc_roc,
    evaluate,
    judge_ranking,
    recall_at,
    recall_at_full_precision,
    results_csv,
)
from core.preprocessing import Pixels
from core.regions import Regions
from core.traverses import tolerance_truth

ALL = np.arange(4)
NO_REGIONS = Regions(
    boxes=np.zeros((0, 4), np.int32),
    energies=np.zeros(0, np.float32),
    channels=np.zeros(0, np.int32),
    layers=np.zeros(0, np.int32),
    features=np.zeros((0, 1), np.float32),
)
# Few different values, so that ties are common.
LABELLED = st.lists(st.tuples(st.integers(-3, 3).map(lambda n: n / 4), st.booleans()), min_size=1, max_size=40)


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
    kept = indices(2, 5, 9)
    outcome = judge_ranking(ranking(0.1, 0.3, 0.2), kept, indices(5))
    assert (outcome.retrieved, outcome.matched, outcome.rank) == (5, True, 1)
    # The only true reference was left out: a true negative, whatever it retrieves.
    negative = judge_ranking(ranking(0.1, 0.3, 0.2), kept, indices(4))
    assert (negative.retrieved, negative.matched, negative.rank) == (5, False, None)


@pytest.mark.parametrize("scores", [[], [0.1, float("nan")], [float("inf"), 0.0]])
def test_scores_must_be_finite(scores: list[float]) -> None:
    with pytest.raises(ValueError, match="finite"):
        judge_ranking(ranking(*scores), np.arange(len(scores)), indices(0))


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


@given(LABELLED)
def test_auc_roc_is_that_of_scikit_learn(labelled: list[tuple[float, bool]]) -> None:
    scores, positive = zip(*labelled, strict=True)
    if len(set(positive)) == 2:
        assert auc_roc(scores, positive) == pytest.approx(roc_auc_score(positive, scores))


def test_recall_leaves_true_negatives_out() -> None:
    ranks = [1, 2, 6, 11, None, None]
    outcomes = [Outcome(0, 0.5, rank == 1, rank) for rank in ranks]
    assert recall_at(outcomes, 1) == 1 / 4
    assert recall_at(outcomes, 5) == 2 / 4
    assert recall_at(outcomes, 10) == 3 / 4
    assert recall_at(outcomes[4:], 1) is None


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


@dataclass
class Lookup:
    """Describes a "frame" by the row of a table; frame n is a 1 x 1 picture of the value n."""

    table: NDArray[np.float32]
    stages: tuple[str, ...] = ("forward",)
    identity: str = "lookup@0"

    def encode(self, pixels: Pixels) -> Encoding:
        return Encoding(self.table[pixels[0, 0, 0]], NO_REGIONS, dict.fromkeys(self.stages, 2.0))

    def scores_from_inner_products(self, inner_products: NDArray[np.float32]) -> NDArray[np.float32]:
        return inner_products / np.float32(2)


def load(path: Path) -> Pixels:
    return np.full((1, 1, 3), int(path.stem), np.uint8)


def test_a_run_by_hand() -> None:
    # Descriptors of references 0–3 (rows 0–3) and of queries 0–3 (rows 4–7).
    table = np.zeros((8, 4), np.float32)
    table[:4] = np.eye(4)
    table[4] = [0.8, 0.2, 0.0, 0.0]  # retrieves 0: right, score 0.4
    table[5] = [0.0, 0.3, 0.6, 0.0]  # would retrieve 2, which is left out; 1 is second: right, 0.15
    table[6] = [1.0, 0.0, 0.0, 0.0]  # its reference 2 is left out; retrieves 0 with the score 0.5
    table[7] = [0.0, 0.0, 0.0, 1.0]  # retrieves 3: right, score 0.5
    references = [Path(f"{n}.png") for n in range(4)]
    queries = [Path(f"{n}.png") for n in range(4, 8)]
    kept = indices(0, 1, 3)
    seen: list[None] = []

    figures, outcomes = evaluate(
        Lookup(table), references, queries, tolerance_truth(4, 4, 0), kept, load, lambda: seen.append(None)
    )

    assert [(o.retrieved, o.matched, o.rank) for o in outcomes] == [
        (0, True, 1),
        (1, True, 1),
        (0, False, None),
        (3, True, 1),
    ]
    assert [o.score for o in outcomes] == pytest.approx([0.4, 0.15, 0.5, 0.5])
    # Ranked: {0.5 right, 0.5 wrong}, 0.4 right, 0.15 right: (0, 1), (1/3, 1/2), (2/3, 2/3), (1, 3/4).
    assert figures.auc_pr == pytest.approx((1.5 / 2 + (1 / 2 + 2 / 3) / 2 + (2 / 3 + 3 / 4) / 2) / 3)
    assert figures.auc_roc == pytest.approx(0.5 / 3)
    assert figures.recall_at == {"1": 1.0, "5": 1.0, "10": 1.0}
    assert figures.recall_at_full_precision == 0.0
    assert (figures.queries, figures.references, figures.encoder) == (4, 3, "lookup@0")
    assert figures.milliseconds["forward"] == 2.0
    assert cast(float, figures.milliseconds["match"]) > 0
    assert figures.milliseconds["regions"] is None
    assert figures.milliseconds["vlad"] is None
    assert len(seen) == 3 + 4


def test_blank_frames_score_zero_and_stay_valid() -> None:
    table = np.zeros((3, 2), np.float32)
    table[0] = [1.0, 0.0]
    figures, outcomes = evaluate(
        Lookup(table), [Path("0.png"), Path("1.png")], [Path("2.png")], [indices(1)], indices(0, 1), load
    )
    assert outcomes == [Outcome(0, 0.0, False, 2)]
    assert figures.auc_pr == 0.0
    assert figures.recall_at == {"1": 0.0, "5": 1.0, "10": 1.0}
    assert figures.auc_roc is None


def test_a_run_needs_a_reference() -> None:
    with pytest.raises(ValueError, match="no reference"):
        evaluate(Lookup(np.zeros((1, 1), np.float32)), [], [Path("0.png")], [indices()], indices(), load)


def test_results_are_one_row_a_query() -> None:
    score = float(np.float32(0.1))
    text = results_csv([Outcome(7, score, True, 1), Outcome(3, -0.25, False, None)])
    assert text == "query,retrieved,score,matched\n0,7,0.100000001,1\n1,3,-0.25,0\n"
    rows = list(csv.DictReader(text.splitlines()))
    assert np.float32(rows[0]["score"]) == np.float32(score)
