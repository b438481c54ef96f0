"""Whether a system knows when it is right, on scores made up by a known law."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lab.evaluation.protocol.outcomes import Outcome, judge
from lab.evaluation.protocol.trust import NO_ORDER, TOO_FEW, decisions, doubt, trust, trust_figures

N = 200


def run(noise: float, seed: int = 0) -> tuple[NDArray[np.float32], list[Outcome]]:
    """Each query's place scores high where the noise lets it; others lower."""
    generator = np.random.default_rng(seed)
    scores = generator.uniform(0.2, 0.4, (N, N)).astype(np.float32)
    scores[np.arange(N), np.arange(N)] += generator.uniform(0, noise, N).astype(np.float32)
    return scores, judge(scores, np.arange(N), [np.array([i]) for i in range(N)])


def test_a_system_that_knows() -> None:
    scores, outcomes = run(0.8)
    found, why = trust(scores, np.arange(N), outcomes)
    assert found is not None and why is None
    assert found.auc_roc_right > 0.95
    assert found.reliability.ece < 0.08
    assert found.reliability.brier < 0.5 * found.reliability.brier_of_base_rate
    assert found.believed_precision.value is not None and found.believed_precision.value > 0.95
    told = trust_figures(scores, np.arange(N), outcomes, {"a": "b"})
    assert (told["ece"], told["brier"]) == (found.reliability.ece, found.reliability.brier)


def test_probabilities_of_a_query_come_from_other_blocks() -> None:
    """Were they fitted on all, the one block whose scores mean nothing would not be betrayed by its Brier score."""
    scores, outcomes = run(0.8)
    scores[:40] = scores[:40][:, ::-1]
    turned = judge(scores, np.arange(N), [np.array([i]) for i in range(N)])
    honest, betrayed = trust(*(run(0.8)[0], np.arange(N), outcomes))[0], trust(scores, np.arange(N), turned)[0]
    assert honest is not None and betrayed is not None
    assert betrayed.reliability.brier > honest.reliability.brier + 0.05


def test_measures_of_doubt_by_hand() -> None:
    scores = np.full((4, 8), 0.2, np.float32)
    for query, (top, second, beside) in enumerate(
        [(0.9, 0.3, True), (0.8, 0.4, True), (0.7, 0.65, False), (0.6, 0.59, False)]
    ):
        scores[query, 0], scores[query, 7] = top, second
        scores[query, 1:4] = 0.58 if beside else 0.2
    right = np.array([True, True, False, False])
    found = doubt(scores, np.arange(8), right, decisions(scores, np.arange(8)))
    assert (found.decision, found.score, found.ratio, found.spread) == (1.0, 1.0, 1.0, 1.0)
    worst = doubt(scores[:2], np.arange(8), np.array([False, True]), np.array([2.0, 1.0]))
    assert (worst.decision, worst.score, worst.ratio) == (0.25, 0.25, 0.25), "the surer one is wrong"
    alone = doubt(scores[:2, :3], np.arange(3), np.array([True, False]), np.array([1.0, 2.0]))
    assert alone.ratio > 0, "without another place there is nothing to compare with"


def test_the_decision_value_by_hand() -> None:
    scores = np.array([[0.9, 0.8, 0.1, 0.1, 0.4, 0.3]], np.float32)
    assert decisions(scores, np.arange(6)) == pytest.approx([np.sqrt(0.9 * (0.9 - 0.35))])  # 1 to 3 are no rivals
    assert decisions(scores, 10 * np.arange(6)) == pytest.approx([np.sqrt(0.9 * (0.9 - 0.34))])
    assert decisions(scores - 1, np.arange(6)) == pytest.approx([-0.1]), "scores under zero have no geometric mean"
    assert decisions(scores[:, :2], np.arange(2)) == pytest.approx([0.9]), "nothing else to lead over"


def test_why_there_are_no_figures() -> None:
    scores, outcomes = run(5.0)
    assert trust(scores[:8], np.arange(N), outcomes[:8]) == (None, TOO_FEW)
    assert trust_figures(scores[:8], np.arange(N), outcomes[:8], {})["notes"] == {"ece": TOO_FEW}
    scores, outcomes = run(0.8)
    against = [
        Outcome(one.retrieved, one.score, value < np.median(decisions(scores, np.arange(N))), one.rank)
        for one, value in zip(outcomes, decisions(scores, np.arange(N)), strict=True)
    ]
    assert trust(scores, np.arange(N), against) == (None, NO_ORDER)
