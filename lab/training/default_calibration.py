"""The curve, threshold and margin that an encoder ships with, measured on frames held out of training.

Each trial is one query against a map that holds its place, or from which its place was taken out.
Three kinds of maps (validation.py) count alike: a street traverse with either half of its references
left out, webcams over months, and webcams by night shifted sideways.  All of these maps are large; what changes in
small ones is fitted to others (map_sizes.py).

Run as a program, it measures the calibration of the packaged encoders again and stores it; nothing is
trained, and the encoders' identities stay.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from core.judgement.calibration import FALSE_ACCEPTS, LOST_BY_MARGIN
from core.judgement.curves import auc_roc
from core.judgement.geometry import TERMS
from core.judgement.probability import Curve, fit_curve
from core.judgement.reliability import reliability
from core.judgement.trials import Trial, Trials, gathered, joined
from core.judgement.verdict import Calibration, judge
from core.method.catalogue import ENCODER_SUFFIX, NETWORK_SUFFIX, PACKAGED, load_encoder, save_calibration
from core.method.encoder import Encoder
from core.method.presets import NETWORK, PRESETS
from core.places import Neighborhood, Whereabouts
from lab.training.map_sizes import fit_environment, fit_small_maps, fitting_traverses, widened
from lab.training.validation import (
    DISTRACTORS,
    CameraTask,
    Encodings,
    ValidationTasks,
    camera_recall,
    camera_scores,
    describe,
    load_tasks,
    scores,
)

Array = NDArray[np.float32]

NEIGHBORHOOD = Neighborhood(radius=5.0, frames=3)
UNCALIBRATED = Calibration(
    source="encoder-default", threshold=0, margin=0, background_mean=0.0, background_deviation=1.0, decision="leading"
)


def judged_trials(scores: Array, truth: NDArray[np.bool_], calibration: Calibration, examined: int) -> Trials:
    """Judge every query against one map whose places are consecutive frames.

    Args:
        scores: float32 [Q, R].
        truth: bool [Q, R].
        examined: candidates of the encoder's second stage; 0 without one.
    """
    made = []
    frames = Whereabouts.along_sequence(np.arange(scores.shape[1]))
    for number, (query, true) in enumerate(zip(scores, truth, strict=True)):
        order = np.argsort(-query, kind="stable")
        judgement = judge(query[order], frames.take(order), calibration, NEIGHBORHOOD, examined)
        made.append(Trial(judgement, bool(true.any()), bool(true[order[0]]), number))
    return gathered(made)


def traverse_trials(
    truth: NDArray[np.bool_], halves: Sequence[tuple[slice, Array]], calibration: Calibration, examined: int
) -> Trials:
    """Queries of one traverse against maps of parts of the other.

    Args:
        truth: bool [Q, R].
        halves: the references of each map, and the scores against them, float32 [Q, part].
    """
    parts = [judged_trials(scores, truth[:, part], calibration, examined) for part, scores in halves]
    return joined(parts, same_frames=True)


def camera_trials(
    task: CameraTask, scores: Array, distractors: Array, calibration: Calibration, examined: int
) -> Trials:
    """One reference a camera among the distractors, and the same map without it.

    Args:
        scores: float32 [n, n] among the pictures.
        distractors: float32 [n, m] of the pictures against the distractors.
    """
    cameras = np.unique(task.camera)
    first = {c: int(np.flatnonzero((task.camera == c) & task.reference)[0]) for c in cameras}
    parts = []
    for camera in cameras:
        queried = np.flatnonzero((task.camera == camera) & task.query & (np.arange(len(scores)) != first[camera]))
        others = [first[c] for c in cameras if c != camera]
        without = np.hstack([distractors[queried], scores[np.ix_(queried, np.array(others))]])
        nothing = np.zeros(without.shape, np.bool_)
        whole = np.hstack([without, scores[queried, first[camera]][:, None]])
        truth = np.hstack([nothing, np.ones((len(queried), 1), np.bool_)])
        pair = [(without, nothing), (whole, truth)]
        parts.append(joined([judged_trials(*one, calibration, examined) for one in pair], same_frames=True))
    return joined(parts)


def choose_calibration(maps: list[Trials], calibration: Calibration) -> Calibration:
    """Curve, threshold and margin for trials on several kinds of maps, each kind counting alike.

    The margin is the highest that costs at most LOST_BY_MARGIN of the right answers.  The threshold
    is the lowest at which, with that margin, at most FALSE_ACCEPTS of the unknown places are
    recognized, averaged over the kinds.
    """
    margin = max(0.0, float(np.quantile(np.concatenate([t.margin[t.right] for t in maps]), LOST_BY_MARGIN)))
    strangers = [t.decision[~t.known & (t.margin >= margin)] for t in maps]
    unknown = [int((~t.known).sum()) for t in maps]
    steps = np.linspace(0, 1, 4001)
    accepted = [[float((s >= step).sum()) / n for step in steps] for s, n in zip(strangers, unknown, strict=True)]
    threshold = float(steps[int(np.argmax(np.mean(accepted, axis=0) <= FALSE_ACCEPTS))])
    every = joined(maps)
    shares = np.concatenate([np.full(len(t), 1 / len(t)) for t in maps])
    fitted = fit_curve(every.decision, every.right, shares)
    curve = Curve(slope=round(fitted.slope, 3), intercept=round(fitted.intercept, 4))
    frames = len(np.unique(every.frame))
    found = {"threshold": round(threshold, 4), "margin": round(margin, 5), "curve": curve, "frames": frames}
    return calibration.model_copy(update=found)


def verdict_rates(t: Trials, calibration: Calibration) -> dict[str, float]:
    """Shares of unknown places recognized, and of known places recognized rightly and wrongly."""
    recognized = (t.decision >= calibration.threshold) & (t.margin >= calibration.margin)
    return {
        "unknown_recognized": float(recognized[~t.known].mean()),
        "known_recognized_right": float((recognized & t.right)[t.known].mean()),
        "known_recognized_wrong": float((recognized & ~t.right)[t.known].mean()),
    }


def probability_quality(t: Trials, calibration: Calibration) -> dict[str, float]:
    """Expected calibration error, and the Brier score, also as a share of that of the constant base rate."""
    found = reliability(t.probabilities(calibration), t.right)
    return {"ece": found.ece, "brier": found.brier, "brier_by_base_rate": found.brier / found.brier_of_base_rate}


def for_small_maps(encoder: Encoder, datasets: Path, calibration: Calibration) -> Calibration:
    """The calibration with what it needs in maps of a few places, and for geometric evidence (``map_sizes.py``)."""
    traverses = list(fitting_traverses(encoder, datasets))
    environment = fit_environment(encoder, datasets, traverses)
    found = calibration.model_copy(update={"environment": environment, "geometry": TERMS})
    found = found.model_copy(update={"environment": widened(found, traverses)})
    return found.model_copy(update={"curve": fit_small_maps(found, traverses)})


def assess(encoder: Encoder, tasks: ValidationTasks) -> tuple[Calibration, dict[str, Any]]:
    """The calibration measured on the tasks, and the figures on them."""
    queries, references = describe(encoder, tasks.lip6.queries), describe(encoder, tasks.lip6.references)
    far = references.part(slice(0, DISTRACTORS))
    walked = scores(encoder, queries, references)
    middle, end = len(references.local) // 2, len(references.local)
    parts = [slice(0, middle), slice(middle, end)]
    halves = [(part, scores(encoder, queries, references.part(part))) for part in parts]
    cameras = {}
    for name, task in (("webcams", tasks.webcams), ("night", tasks.night)):
        cameras[name] = (task, *camera_scores(encoder, describe(encoder, task.pictures), far))
    start = UNCALIBRATED.model_copy(update=background(encoder, describe(encoder, tasks.webcams.pictures), far))

    def all_trials(calibration: Calibration) -> dict[str, Trials]:
        made = {"lip6": traverse_trials(tasks.lip6.truth, halves, calibration, encoder.candidates)}
        for name, (task, among, apart) in cameras.items():
            made[name] = camera_trials(task, among, apart, calibration, encoder.candidates)
        return made

    outcomes = all_trials(start)
    calibration = choose_calibration(list(outcomes.values()), start)
    best = walked.argmax(axis=1)
    figures: dict[str, Any] = {
        "lip6_recall_at_1": float(tasks.lip6.truth[np.arange(len(best)), best].mean()),
        "lip6_recall_at_1_as_stated": float(tasks.lip6_as_stated.truth[np.arange(len(best)), best].mean()),
        "verdicts": {name: verdict_rates(outcome, calibration) for name, outcome in outcomes.items()},
        "probabilities": {name: probability_quality(outcome, calibration) for name, outcome in outcomes.items()},
        "unseen": {name: _unseen(name, outcomes, start) for name in outcomes},
        "decision_auc_roc": {
            name: auc_roc(outcome.decision, outcome.known & outcome.right) for name, outcome in outcomes.items()
        },
    }
    for name, (task, among, apart) in cameras.items():
        figures[f"{name}_recall_at_1"] = camera_recall(task, among, apart)
    return calibration, figures


def _unseen(name: str, outcomes: dict[str, Trials], start: Calibration) -> dict[str, float]:
    """The figures on one kind of maps by a calibration from the others."""
    calibration = choose_calibration([outcome for other, outcome in outcomes.items() if other != name], start)
    return {**verdict_rates(outcomes[name], calibration), **probability_quality(outcomes[name], calibration)}


def background(encoder: Encoder, frames: Encodings, unrelated: Encodings) -> dict[str, float]:
    """Mean and deviation of the scores of unrelated frames, which stand for missing places in a map of few."""
    first = encoder.scores_from_inner_products(frames.descriptors @ unrelated.descriptors.T)
    gains = np.stack([encoder.agreement(cells, unrelated.local) for cells in frames.local])
    examined = first + gains
    return {
        "background_mean": round(float(examined.mean()), 5),
        "background_deviation": round(float(examined.std()), 5),
    }


def main(
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    models: Annotated[Path, typer.Option(help="Folder of the model files.")] = PACKAGED,
    encoder: Annotated[list[str] | None, typer.Option(help="Which; all presets if left out.")] = None,
    dry_run: Annotated[bool, typer.Option(help="Measure and print, store nothing.")] = False,
) -> None:
    """Measure the calibration of each encoder on the validation tasks, print it with all figures, and store it."""
    tasks = load_tasks(datasets)
    for name in encoder or list(PRESETS):
        path = models / f"{name}{ENCODER_SUFFIX}"
        loaded = load_encoder(path, models / f"{NETWORK}{NETWORK_SUFFIX}")
        calibration, figures = assess(loaded, tasks)
        calibration = for_small_maps(loaded, datasets, calibration)
        if not dry_run:
            save_calibration(path, calibration)
            load_encoder(path, models / f"{NETWORK}{NETWORK_SUFFIX}").check_golden()
        made = {"encoder": loaded.identity, "calibration": calibration.model_dump(), **figures}
        typer.echo(json.dumps(made, indent=2))


if __name__ == "__main__":
    typer.run(main)
