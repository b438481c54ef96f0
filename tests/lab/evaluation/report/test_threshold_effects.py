from __future__ import annotations

import numpy as np
import pytest

from lab.evaluation.protocol.thresholds import Counts, thresholdings
from lab.evaluation.report.threshold_effects import fate, fate_before, plot_fates, scores_by_fate
from tests.lab.evaluation.report.comparisons import outcome

OUTCOMES = [
    outcome(0.9, matched=True),
    outcome(0.7, matched=True),
    outcome(0.2, matched=True),
    outcome(0.6),
    outcome(0.1),
    outcome(0.5, negative=True),
    outcome(0.3, negative=True),
]


def test_fates_by_hand() -> None:
    assert [fate_before(one) for one in OUTCOMES] == ["tp", "tp", "tp", "fp", "fp", "tn", "tn"]
    assert [fate(one, 0.4) for one in OUTCOMES] == ["tp", "tp", "fn", "fp", "fn", "fp", "tn"]
    assert fate(outcome(0.4, matched=True), 0.4) == "fn", "a match is accepted above the threshold, not at it"


def test_scores_fall() -> None:
    found = scores_by_fate(OUTCOMES, 0.4)
    assert {name: scores.tolist() for name, scores in found.items()} == {
        "tp": [0.9, 0.7],
        "fp": [0.6, 0.5],
        "tn": [0.3],
        "fn": [0.2, 0.1],
    }


def test_plots_count_as_the_evaluation_does() -> None:
    generator = np.random.default_rng(0)
    outcomes = [
        outcome(float(score), matched=kind == 0, negative=kind == 1)
        for score, kind in zip(generator.random(60).round(2), generator.integers(0, 3, 60), strict=True)
    ]
    for thresholding in thresholdings(outcomes):
        for least, counts in ((None, thresholding.before), (thresholding.threshold, thresholding.after)):
            lengths = {name: len(scores) for name, scores in scores_by_fate(outcomes, least).items()}
            assert counts == Counts(
                true_positives=lengths["tp"],
                false_positives=lengths["fp"],
                false_negatives=lengths["fn"],
                true_negatives=lengths["tn"],
            )


@pytest.mark.thorough
def test_texts_give_the_counts() -> None:
    before, after = plot_fates("x", "HOG", OUTCOMES, 0.4)
    assert (before.name, after.name) == ("scores-before-x", "scores-after-x")
    assert before.alt == "Before the threshold, scores of HOG: 3 TP, 2 FP, 2 TN and 0 FN."
    assert after.alt == "After the threshold, scores of HOG: 2 TP, 2 FP, 1 TN and 2 FN."


@pytest.mark.thorough
def test_equal_scores_can_be_drawn() -> None:
    assert len(plot_fates("x", "HOG", [outcome(0.0, matched=True)] * 3, None)) == 1
    assert len(plot_fates("x", "HOG", [outcome(-2.0)], -2.0)) == 2
