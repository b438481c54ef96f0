"""Which calibrations may be stored: by what they change for answers that had no part in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.judgement.acceptance import HeldOutChange, held_out_change
from core.judgement.calibration import FittedCalibration, Target, adjust_calibration, fit_map_calibration
from core.judgement.probability import Curve
from core.judgement.reliability import brier
from core.judgement.trials import StagedTrials, Trials, joined
from tests.core.judgement.test_calibration import BASE, LAW, PRECISE, drawn, labels

TRUE = BASE.model_copy(update={"curve": LAW, "threshold": 0.15})


def fitted(trials: Trials, target: Target = PRECISE) -> FittedCalibration:
    return fit_map_calibration(trials, BASE, target, "sequence:tuesday")


def changed(found: FittedCalibration, before: Curve = LAW, drawn_strangers: Trials | None = None) -> HeldOutChange:
    drawn_ones = None if drawn_strangers is None else StagedTrials.of(drawn_strangers)
    told = held_out_change(found, BASE.model_copy(update={"curve": before}), drawn_ones)
    assert told is not None
    return told


@pytest.mark.parametrize("before", [Curve(slope=60, intercept=-3), Curve(slope=60, intercept=-10), LAW])
@pytest.mark.parametrize("frames", [40, 400])
def test_an_honest_calibration_is_accepted(before: Curve, frames: int) -> None:
    """One of too sure, of too timid and of true probabilities; and the same once more, over itself."""
    found = fitted(drawn(frames))
    assert changed(found, before).worse is None
    assert held_out_change(found, found.calibration).worse is None  # type: ignore[union-attr]
    told = changed(found, before)
    assert told.known is not None and told.strangers is not None
    assert (told.known.answers, told.strangers.answers) == (frames, frames)


def test_the_figures_are_those_of_held_out_answers() -> None:
    found = fitted(drawn(200))
    told = changed(found)
    assert told.known is not None and told.strangers is not None
    held = found.measurement.cross_validated.reliability
    assert (told.known.after.error + told.strangers.after.error) / 2 == pytest.approx(held.brier)
    known = found.trials.known
    assert told.strangers.before.error == pytest.approx(brier(found.trials.probabilities(TRUE)[~known], np.zeros(200)))


def test_labels_that_make_strangers_likely_are_refused() -> None:
    """Three labelled strangers that resemble nothing say little of those that resemble the map."""
    some = labels(30, 3, right=30)
    asked = replace(some, decision=np.where(some.known, some.decision, -0.4))
    found = adjust_calibration(asked, BASE.model_copy(update={"curve": Curve(slope=60, intercept=-9)}), "labels")
    before = Curve(slope=60, intercept=-9)
    strangers = labels(0, 60, right=0)
    assert changed(found, before).worse is None, "by the labels alone nothing speaks against it"
    told = changed(found, before, strangers)
    assert told.worse is not None and "strangers would be believed" in told.worse
    assert told.strangers is not None and told.strangers.answers == 63
    assert told.strangers.after.probability > told.strangers.before.probability + 0.3
    assert f"{told.strangers.after.probability:.3f}" in told.worse


def test_a_calibration_that_makes_held_out_answers_worse_is_refused() -> None:
    """The curve in force knows that answers of a map of few places are less sure; one that is fitted does not."""
    law = Curve(slope=60, intercept=-6, imagined_intercept=-12)
    few = drawn(300, Curve(slope=60, intercept=-18))
    found = fitted(joined([drawn(300, seed=1), replace(few, imagined=np.ones(len(few)))]))
    told = changed(found, law)
    assert told.worse is not None and "had no part" in told.worse
    assert told.known is not None and told.known.after.error > told.known.before.error + 0.02


def test_a_calibration_without_a_curve_in_force_leaves_nothing_to_compare() -> None:
    assert held_out_change(fitted(drawn(40)), BASE) is None
