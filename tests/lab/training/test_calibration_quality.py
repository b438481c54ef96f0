"""How good a map's own calibration is on a real traverse (``lab.training.calibration_quality``)."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from core.frames.images import decode
from core.frames.traverses import find_images
from core.judgement.calibration import Measurement, Target, fit_map_calibration, held_figures
from core.judgement.trials import Trials
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from lab.training.calibration_quality import half_trials, widened
from lab.training.validation import Encodings, describe

EVAL = Path(__file__).parents[4] / "shared/datasets/eval"

pytestmark = pytest.mark.skipif(not EVAL.is_dir(), reason="the evaluation images are not on this machine")


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return EncoderCatalogue().get(DEFAULT_ENCODER)


def shown(encoder: Encoder, folder: Path) -> Encodings:
    return describe(encoder, [decode(path.read_bytes()) for path in find_images(folder)])


@pytest.fixture(scope="module")
def corridor(encoder: Encoder) -> list[Trials]:
    """Within two frames, as stated, and within three, what a map takes for the same place."""
    with (EVAL / "corridor/ground_truth.csv").open() as file:
        pairs = [(int(row["query"]), int(row["reference"])) for row in csv.DictReader(file)]
    truth = np.zeros((111, 111), np.bool_)
    truth[tuple(np.transpose(pairs))] = True
    queries, references = (shown(encoder, EVAL / "corridor" / side) for side in ("query", "ref"))
    return half_trials(encoder, queries, references, [truth, widened(truth, 1)])


def measured(encoder: Encoder, of: Trials, precision: float) -> Measurement:
    return fit_map_calibration(of, encoder.calibration, Target(rule="precision", value=precision), "test").measurement


def assert_honest(found: Measurement) -> None:
    worth = found.cross_validated.reliability
    assert worth.ece <= 0.06, worth
    assert worth.brier <= 0.7 * worth.brier_of_base_rate, worth


@pytest.mark.thorough
def test_corridor(encoder: Encoder, corridor: list[Trials]) -> None:
    exact, same_place = (measured(encoder, of, precision) for of, precision in zip(corridor, (0.95, 0.98), strict=True))
    assert_honest(exact)
    assert exact.auc_roc is not None and exact.auc_roc >= 0.93
    assert exact.auc_roc_right >= 0.92
    held = exact.cross_validated
    # Two of the answers most believed are one frame farther off than the truth allows.
    assert held.precision.value is not None and held.precision.value >= 0.94, held.precision
    assert held.recall.value is not None and held.recall.value >= 0.5, held.recall
    held = same_place.cross_validated
    assert held.precision.value is not None and held.precision.value >= 0.98, held.precision
    assert held.recall.value is not None and held.recall.value >= 0.5, held.recall


@pytest.mark.thorough
def test_the_default_on_a_walk_that_it_never_saw(encoder: Encoder, corridor: list[Trials]) -> None:
    exact = corridor[0]
    found = held_figures(exact, exact.recognized(encoder.calibration), exact.probabilities(encoder.calibration))
    assert found.reliability.brier <= 0.6 * found.reliability.brier_of_base_rate
    assert found.false_accept_rate.value is not None and found.false_accept_rate.value <= 0.1
    # Half of corridor is 55 places, for which a little of the background is imagined; with all of it 0.7 are found.
    assert found.recall.value is not None and found.recall.value >= 0.65
