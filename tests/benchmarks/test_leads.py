"""How much a lead says is found again in outcomes that were drawn by it."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.geometry.leads import WALKS, VerifiedAnswers, fitted_lead, lead_figures, mean_loss
from core.judgement.geometry import LEAD, TERMS
from core.judgement.verdict import Calibration, Judgement
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue

WEIGHT, CONSTANT = 3.0, -4.0


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return EncoderCatalogue().get(DEFAULT_ENCODER).calibration


def drawn(calibration: Calibration, seed: int, count: int = 4000) -> VerifiedAnswers:
    """Answers that are right as often as WEIGHT and CONSTANT say."""
    generator = np.random.default_rng(seed)
    values = generator.uniform((0, 0, 0.01), (0.3, 60, 0.1), (count, 3)).tolist()
    made = [Judgement("recognized", 0.3, decision, lead, 1, 0.5, evidence=found) for decision, found, lead in values]
    answers = VerifiedAnswers.of([(one, True) for one in made], calibration)
    right = generator.random(count) < answers.probabilities(WEIGHT, CONSTANT)
    return VerifiedAnswers(answers.odds, answers.imagined, answers.margin, answers.left, right)


def test_the_numbers_that_outcomes_were_drawn_by_are_found(calibration: Calibration) -> None:
    by_kind = {kind: [drawn(calibration, seed)] for seed, kind in enumerate(WALKS)}
    weight, constant, loss = fitted_lead(by_kind)
    assert (weight, constant) == pytest.approx((WEIGHT, CONSTANT), abs=0.3)
    assert loss <= mean_loss(by_kind, WEIGHT, CONSTANT, LEAD) + 1e-9
    rows = lead_figures(by_kind | {"displaced": [drawn(calibration, 9, 10)]})
    assert rows[f"all, {LEAD}"] == {"weight": weight, "constant": constant, "loss": loss}
    assert {f"without {kind}, {LEAD}" for kind in WALKS} < set(rows)
    assert rows["shipped"]["loss"] > loss and rows["no lead, its best constant"]["loss"] > loss


def test_answers_that_were_not_verified_are_left_out(calibration: Calibration) -> None:
    plain = Judgement("recognized", 0.3, 0.2, 0.1, 1, 0.9)
    lonely = Judgement("unknown", 0.3, 0.2, None, None, 0.2, 1.0, evidence=10.0)
    answers = VerifiedAnswers.of([(plain, True), (lonely, False)], calibration)
    assert answers.right.tolist() == [False] and answers.margin.tolist() == [np.inf]
    assert answers.probabilities(TERMS.lead, -3.0) == answers.probabilities(0.0, -3.0), "there is none to lead"
