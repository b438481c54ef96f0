"""Turns distilled weights into the packaged encoders: vocabularies, calibration, golden values, files."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.progress import track
from safetensors.torch import load_file
from torch import Tensor

from core.frames.preprocessing import Pixels
from core.judgement.curves import auc_roc
from core.judgement.trials import Trials
from core.judgement.verdict import Calibration
from core.method.catalogue import NETWORK_SUFFIX, PACKAGED, save_encoder
from core.method.encoder import Encoder, EncoderDefinition
from core.method.features import FeatureExtractor
from core.method.presets import NETWORK, PRESETS
from core.method.vocabulary import Vocabulary, pool_features, train_vocabulary
from core.networks.network import ShallowNetwork, save_network
from training.calibration import camera_trials, choose, rates, walk_trials, worth
from training.photographs import read, split_photographs
from training.projection import fit_projections
from training.student import student_definition
from training.validation import (
    DISTRACTORS,
    Cameras,
    Shown,
    Walk,
    camera_recall,
    camera_scores,
    describe,
    realigned,
    scores,
    shifted_night,
    walk,
    webcams,
)

Array = NDArray[np.float32]

VOCABULARY_IMAGES = 2600  # as many as the thesis pools for its vocabularies
UNCALIBRATED = Calibration(
    source="encoder-default", threshold=0, margin=0, background_mean=0.0, background_deviation=1.0, decision="leading"
)


@dataclass(frozen=True)
class Tasks:
    """The three validation tasks; of lip6 with the truth as it is stated, too."""

    lip6: Walk
    lip6_as_stated: Walk
    webcams: Cameras
    night: Cameras


def load_tasks(datasets: Path) -> Tasks:
    """Read the validation pictures into memory."""
    stated = walk(datasets / "eval/lip6_outdoor", "query", "reference")
    distractors = stated.references[:DISTRACTORS]
    fixed = webcams(datasets / "eval/webcams", distractors), shifted_night(datasets / "train", distractors)
    return Tasks(realigned(stated), stated, *fixed)


def vocabulary_pictures(datasets: Path, count: int, seed: int) -> list[Pixels]:
    """A random choice of the training photographs."""
    paths = split_photographs(datasets / "train").train
    chosen = np.random.default_rng(seed).choice(len(paths), min(count, len(paths)), replace=False)
    return [read(paths[index]) for index in sorted(chosen)]


def network_of(weights: dict[str, Tensor], layers: Sequence[str], side: int | None = None) -> ShallowNetwork:
    """The distilled backbone as deep as ``layers`` needs; ``side`` makes its input another size than its own."""
    definition = student_definition()
    if side is not None:
        shown = definition.input.model_copy(update={"height": side, "width": side})
        definition = definition.model_copy(update={"input": shown})
    network = ShallowNetwork(definition, layers)
    network.load_weights(weights)
    return network.eval().requires_grad_(False)


def build(
    name: str,
    definition: EncoderDefinition,
    weights: dict[str, Tensor],
    photographs: Path,
    pictures: Sequence[Pixels],
    seed: int,
) -> tuple[Encoder, Vocabulary]:
    """An encoder, not yet calibrated: projections fitted to ``photographs``, a vocabulary trained on ``pictures``."""
    network, wanted = network_of(weights, definition.outputs), definition.projected()
    projections = fit_projections(network, wanted, photographs, seed=seed) if wanted else {}
    extractor = FeatureExtractor(network, definition, projections)
    frames = (
        extractor.regions(extractor.activations([picture])[0]).features
        for picture in track(pictures, f"features for {name}")
    )
    vocabulary = train_vocabulary(pool_features(frames, seed), definition.words, seed, extractor.origin)
    return Encoder(name, extractor, definition, vocabulary, UNCALIBRATED), vocabulary


def assess(encoder: Encoder, tasks: Tasks) -> tuple[Calibration, dict[str, Any]]:
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
        made = {"lip6": walk_trials(tasks.lip6.truth, halves, calibration, encoder.candidates)}
        for name, (task, among, apart) in cameras.items():
            made[name] = camera_trials(task, among, apart, calibration, encoder.candidates)
        return made

    outcomes = all_trials(start)
    calibration = choose(list(outcomes.values()), start)
    best = walked.argmax(axis=1)
    figures: dict[str, Any] = {
        "lip6_recall_at_1": float(tasks.lip6.truth[np.arange(len(best)), best].mean()),
        "lip6_recall_at_1_as_stated": float(tasks.lip6_as_stated.truth[np.arange(len(best)), best].mean()),
        "verdicts": {name: rates(outcome, calibration) for name, outcome in outcomes.items()},
        "probabilities": {name: worth(outcome, calibration) for name, outcome in outcomes.items()},
        "unseen": {name: _unseen(name, outcomes, start) for name in outcomes},
        "decision_auc_roc": {
            name: auc_roc(outcome.decision, outcome.known & outcome.right) for name, outcome in outcomes.items()
        },
    }
    for name, (task, among, apart) in cameras.items():
        figures[f"{name}_recall_at_1"] = camera_recall(task, among, apart)
    return calibration, figures


def _unseen(name: str, outcomes: dict[str, Trials], start: Calibration) -> dict[str, float]:
    """What the calibration of the other kinds of maps does on the one named."""
    calibration = choose([outcome for other, outcome in outcomes.items() if other != name], start)
    return {**rates(outcomes[name], calibration), **worth(outcomes[name], calibration)}


def background(encoder: Encoder, frames: Shown, unrelated: Shown) -> dict[str, float]:
    """How unrelated frames score when the second stage has examined them: what a map of a few places is filled with."""
    first = encoder.scores_from_inner_products(frames.descriptors @ unrelated.descriptors.T)
    gains = np.stack([encoder.agreement(cells, unrelated.local) for cells in frames.local])
    examined = first + gains
    return {
        "background_mean": round(float(examined.mean()), 5),
        "background_deviation": round(float(examined.std()), 5),
    }


def main(
    weights: Annotated[Path, typer.Option(help="Folded weights of the distillation.")] = Path(
        "runs/distillation/weights.safetensors"
    ),
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    output: Annotated[Path, typer.Option(help="Where the model files go.")] = PACKAGED,
    images: Annotated[int, typer.Option(min=1, help="Photographs for the vocabularies.")] = VOCABULARY_IMAGES,
    seed: int = 0,
) -> None:
    """Write the network and one encoder file for each preset, and print what they reach."""
    torch.manual_seed(seed)
    output.mkdir(parents=True, exist_ok=True)
    tensors = load_file(weights)
    pictures, tasks = vocabulary_pictures(datasets, images, seed), load_tasks(datasets)
    # The encoders of one network go with it, so all files change together, at the end.
    with TemporaryDirectory(dir=output, prefix="unfinished-") as unfinished:
        folder = Path(unfinished)
        save_network(folder / f"{NETWORK}{NETWORK_SUFFIX}", student_definition(), tensors)
        for name, definition in PRESETS.items():
            encoder, vocabulary = build(name, definition, tensors, datasets / "train", pictures, seed)
            calibration, figures = assess(encoder, tasks)
            encoder.calibration = calibration
            training = {"images": len(pictures), "seed": seed, "source": "training photographs, see MODEL_CARD.md"}
            save_encoder(folder, encoder, vocabulary, NETWORK, training)
            made = {"encoder": encoder.identity, "calibration": calibration.model_dump(), **figures}
            typer.echo(json.dumps(made, indent=2))
        for path in sorted(folder.iterdir()):
            os.replace(path, output / path.name)


if __name__ == "__main__":
    typer.run(main)
