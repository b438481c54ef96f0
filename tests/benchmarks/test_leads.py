"""How much a lead says is found again in outcomes that were drawn by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.geometry.leads import WALKS, fitted_lead, lead_figures, loss, mean_loss
from core.judgement.geometry import LEAD, TERMS
from core.judgement.trials import Trial, Trials, gathered
from core.judgement.verdict import Calibration, Judgement
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue

WEIGHT, CONSTANT = 3.0, -4.0


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return EncoderCatalogue().get(DEFAULT_ENCODER).calibration


def drawn(calibration: Calibration, seed: int, count: int = 4000) -> Trials:
    """Verified answers that are right as often as WEIGHT and CONSTANT say."""
    generator = np.random.default_rng(seed)
    decision, evidence, margin = generator.uniform((0, 0, 0.01), (0.3, 60, 0.1), (count, 3)).T
    flags = np.ones(count, np.bool_)
    trials = Trials(decision, margin, flags, flags, np.arange(count), evidence=evidence)
    terms = TERMS.model_copy(update={"lead": WEIGHT, "intercept": CONSTANT})
    stated = trials.probabilities(calibration.model_copy(update={"geometry": terms}))
    return replace(trials, right=generator.random(count) < stated)


def test_the_numbers_that_outcomes_were_drawn_by_are_found(calibration: Calibration) -> None:
    by_kind = {kind: [drawn(calibration, seed)] for seed, kind in enumerate(WALKS)}
    weight, constant, least = fitted_lead(by_kind, calibration)
    assert (weight, constant) == pytest.approx((WEIGHT, CONSTANT), abs=0.3)
    assert least <= mean_loss(by_kind, calibration, WEIGHT, CONSTANT) + 1e-9
    rows = lead_figures(by_kind | {"displaced": [drawn(calibration, 9, 10)]}, calibration)
    assert rows[f"all, {LEAD}"] == {"lead": weight, "intercept": constant, "loss": least}
    assert {f"without {kind}, {LEAD}" for kind in WALKS} < set(rows)
    assert rows["shipped"]["loss"] > least and rows["no lead"]["loss"] > least


def test_answers_that_were_not_verified_are_left_out(calibration: Calibration) -> None:
    plain = Judgement("recognized", 0.3, 0.2, 0.1, 1, 0.9)
    lonely = Judgement("unknown", 0.3, 0.2, None, None, 0.2, 1.0, evidence=10.0)
    verified = gathered([Trial(lonely, True, False, 0)])
    both = gathered([Trial(plain, True, True, 0), Trial(lonely, True, False, 1)])
    shipped = lead_figures({"night": [both], "hall": [both]}, calibration)["shipped"]["loss"]
    assert shipped == loss(verified, calibration, TERMS.lead, TERMS.intercept)
    assert loss(verified, calibration, 2.0, -3.0) == loss(verified, calibration, 0.0, -3.0), "there is none to lead"
