"""How good probabilities and verdicts are on real traverses with half of the references left out.

A map is calibrated on the trials themselves by cross-validation: every block of consecutive queries is judged by the
calibration that the other blocks give.  The default calibration of the encoder stands beside it.  corridor is judged by
its stated truth (within two frames) and within three, which a map takes for the same place; lip6 by its stated truth,
by the corrected truth (``ground_truth.py``), and within five frames of that, since it is good to a few frames only.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from core.errors import CalibrationImpossible
from core.judgement.calibration import Held, Target, fit_map_calibration, held_figures
from core.judgement.curves import auc_roc
from core.judgement.trials import Trial, Trials, gathered
from core.judgement.verdict import judge
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.places import Whereabouts
from core.recognition.stages import examine, second_stage
from lab.training.default_calibration import NEIGHBORHOOD
from lab.training.validation import Encodings, describe, load_traverses, with_corrected_truth

Truth = NDArray[np.bool_]

PRECISIONS = (0.9, 0.95, 0.98)


def widened(truth: Truth, frames: int) -> Truth:
    """The truth with ``frames`` more references on either side; bool [Q, R]."""
    wide = truth.copy()
    for shift in range(1, frames + 1):
        wide[:, shift:] |= truth[:, :-shift]
        wide[:, :-shift] |= truth[:, shift:]
    return wide


def half_trials(encoder: Encoder, queries: Encodings, references: Encodings, truths: Sequence[Truth]) -> list[Trials]:
    """Trials of each query against the first half of the references and the second, for each truth, bool [Q, R]."""
    found: list[list[Trial]] = [[] for _ in truths]
    scores = encoder.scores_from_inner_products(queries.descriptors @ references.descriptors.T)
    middle, end = len(references.local) // 2, len(references.local)
    for number, local in enumerate(queries.local):
        for half in (slice(0, middle), slice(middle, end)):
            order = half.start + np.argsort(-scores[number, half], kind="stable")
            places = Whereabouts.along_sequence(order)
            stage = second_stage(encoder, local, references.local[order].__getitem__)
            seen = examine(scores[number, order], places, NEIGHBORHOOD, *stage)
            judgement = judge(seen.scores, places.take(seen.order), encoder.calibration, NEIGHBORHOOD, seen.examined)
            best = order[seen.order[0]]
            for truth, retained in zip(truths, found, strict=True):
                retained.append(Trial(judgement, bool(truth[number, half].any()), bool(truth[number, best]), number))
    return [gathered(retained) for retained in found]


def figures(held: Held) -> dict[str, Any]:
    """Verdicts and probabilities in a few numbers."""
    worth = held.reliability
    return {
        "precision": held.precision.value,
        "precision_interval": (held.precision.low, held.precision.high),
        "recall": held.recall.value,
        "false_accept_rate": held.false_accept_rate.value,
        "ece": worth.ece,
        "brier_by_base_rate": worth.brier / worth.brier_of_base_rate,
    }


def main(
    datasets: Annotated[Path, typer.Option(help="Folder with eval/.")] = Path("../shared/datasets"),
    encoder: str = DEFAULT_ENCODER,
) -> None:
    """Print the figures on both pairs of traverses, by every truth and for several target precisions."""
    loaded = EncoderCatalogue().get(encoder)
    corridor = load_traverses(datasets / "eval/corridor", "query", "ref")
    lip6 = load_traverses(datasets / "eval/lip6_outdoor", "query", "reference")
    corrected = with_corrected_truth(lip6).truth
    for task, truths in (
        (corridor, {"corridor as stated": corridor.truth, "corridor within 3": widened(corridor.truth, 1)}),
        (lip6, {"lip6 as stated": lip6.truth, "lip6 corrected": corrected, "lip6 within 5": widened(corrected, 3)}),
    ):
        shown = describe(loaded, task.queries), describe(loaded, task.references)
        for name, trials in zip(truths, half_trials(loaded, *shown, list(truths.values())), strict=True):
            made: dict[str, Any] = {
                "auc_roc": auc_roc(trials.decision, trials.known),
                "auc_roc_right": auc_roc(trials.decision, trials.right),
            }
            calibration = loaded.calibration
            made["default"] = figures(
                held_figures(trials, trials.recognized(calibration), trials.probabilities(calibration))
            )
            for wanted in PRECISIONS:
                try:
                    found = fit_map_calibration(trials, calibration, Target(rule="precision", value=wanted), name)
                    made[f"precision {wanted}"] = figures(found.measurement.cross_validated)
                except CalibrationImpossible as error:
                    made[f"precision {wanted}"] = str(error)
            typer.echo(json.dumps({name: made}, indent=2))


if __name__ == "__main__":
    typer.run(main)
