"""Maps cut from traverses, and what is fitted to them."""

from __future__ import annotations

import numpy as np
import pytest

from core.judgement.background import Environment
from core.judgement.probability import Curve
from core.judgement.verdict import Calibration
from training.map_sizes import APART, SMALL, Traverse, cut, fit_small_maps, trials_of_size

CALIBRATION = Calibration(
    source="test",
    threshold=0.09,
    margin=0.004,
    background_mean=0.07,
    background_deviation=0.014,
    curve=Curve(slope=37, intercept=-3.5),
    environment=Environment(mean=0.13, deviation=0.034, mean_weight=0.66, deviation_weight=6.6),
)
COUNT = 80


def traverse(mean: float, seed: int) -> Traverse:
    """Places that score ``mean`` with each other, and 0.1 more where they are the same."""
    random = np.random.default_rng(seed)
    apart = np.abs(np.arange(COUNT)[:, None] - np.arange(COUNT))
    truth = apart <= 2
    both = (random.normal(mean, 0.02, (COUNT, COUNT)) + 0.1 * truth).astype(np.float32)
    return Traverse(both / 4, both, both, truth, 30)


def test_a_stranger_is_far_from_every_place_of_the_map() -> None:
    one = traverse(0.1, 0)
    assert one.strangers(np.arange(20, 30)).tolist() == [
        query for query in range(COUNT) if query + 2 < 20 - APART or query - 2 > 29 + APART
    ]


def test_a_map_is_a_run_or_drawn() -> None:
    generator = np.random.default_rng(0)
    run, drawn = (cut(traverse(0.1, 0), 10, how, generator) for how in ("run", "spread"))
    assert (np.diff(run) == 1).all() and len(run) == 10
    assert (np.diff(drawn) > 0).all() and len(drawn) == 10 and (np.diff(drawn) > 1).any()


@pytest.mark.parametrize("size", SMALL)
def test_trials_are_of_known_places_and_of_strangers(size: int) -> None:
    trials, judgements = trials_of_size(traverse(0.1, 0), size, "run", CALIBRATION, 4)
    assert len(trials) == len(judgements)
    assert trials.known.any() and not trials.known.all()
    assert not trials.right[~trials.known].any()
    assert ((trials.imagined > 0) & (trials.imagined <= 1)).all()


def test_what_is_fitted_makes_probabilities_of_small_maps_honest() -> None:
    """On traverses of other seeds; in half of the environments strangers score as known places do in the others."""
    fitted = [(f"made {seed}", traverse(mean, seed)) for seed, mean in enumerate((0.1, 0.14, 0.18, 0.22))]
    curve = fit_small_maps(CALIBRATION, fitted, repeats=4)
    assert (curve.slope, curve.intercept) == (37, -3.5), "full maps keep theirs"
    better = CALIBRATION.model_copy(update={"curve": curve})
    errors = []
    for calibration in (CALIBRATION, better):
        off = []
        for size in SMALL:
            for seed, mean in enumerate((0.11, 0.15, 0.19, 0.23)):
                trials, _ = trials_of_size(traverse(mean, 10 + seed), size, "run", calibration, 4)
                p, known = trials.probabilities(calibration), trials.known
                loss = np.square(p - trials.right)
                off.append((loss[known].mean() + loss[~known].mean()) / 2)
        errors.append(np.mean(off))
    assert errors[1] < 0.9 * errors[0]
