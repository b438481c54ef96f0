"""Turns distilled weights into the packaged encoders: vocabularies, calibration, golden values, files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.progress import track
from safetensors.torch import load_file
from torch import Tensor

from core.encoder import Encoder, EncoderDefinition, FeatureExtractor
from core.encoders import NETWORK_SUFFIX, PACKAGED, save_encoder
from core.network import ShallowNetwork, save_network
from core.preprocessing import Pixels
from core.presets import NETWORK, PRESETS
from core.verdict import Calibration
from core.vocabulary import Vocabulary, pool_features, train_vocabulary
from training.calibration import Trials, camera_trials, choose, rates, walk_trials
from training.photographs import split_photographs
from training.student import student_definition
from training.validation import DISTRACTORS, Cameras, Walk, camera_recall, read, shifted_night, walk, webcams

Array = NDArray[np.float32]

VOCABULARY_IMAGES = 2600  # as many as the thesis pools for its vocabularies
UNCALIBRATED = Calibration(
    source="encoder-default", threshold=0, margin=0, background_mean=0.0, background_deviation=1.0
)


@dataclass(frozen=True)
class Tasks:
    """The three validation tasks."""

    lip6: Walk
    webcams: Cameras
    night: Cameras


def load_tasks(datasets: Path) -> Tasks:
    """Read the validation pictures into memory."""
    lip6 = walk(datasets / "eval/lip6_outdoor", "query", "reference")
    distractors = lip6.references[:DISTRACTORS]
    return Tasks(lip6, webcams(datasets / "eval/webcams", distractors), shifted_night(datasets / "train", distractors))


def vocabulary_pictures(datasets: Path, count: int, seed: int) -> list[Pixels]:
    """A random choice of the training photographs."""
    paths = split_photographs(datasets / "train").train
    chosen = np.random.default_rng(seed).choice(len(paths), min(count, len(paths)), replace=False)
    return [read(paths[index]) for index in sorted(chosen)]


def network_of(weights: dict[str, Tensor], layers: Sequence[str]) -> ShallowNetwork:
    """The distilled backbone as deep as ``layers`` needs."""
    network = ShallowNetwork(student_definition(), layers)
    network.load_weights(weights)
    return network.eval().requires_grad_(False)


def build(
    name: str, definition: EncoderDefinition, weights: dict[str, Tensor], pictures: Sequence[Pixels], seed: int
) -> tuple[Encoder, Vocabulary]:
    """An encoder with a vocabulary trained on ``pictures``, not yet calibrated."""
    extractor = FeatureExtractor(network_of(weights, definition.layers), definition)
    frames = (
        extractor.regions(extractor.activations([picture])[0]).features
        for picture in track(pictures, f"features for {name}")
    )
    vocabulary = train_vocabulary(pool_features(frames, seed), definition.words, seed, extractor.origin)
    return Encoder(name, extractor, definition, vocabulary, UNCALIBRATED), vocabulary


def descriptors(encoder: Encoder, frames: Sequence[Pixels]) -> Array:
    """float32 [n, D], eight frames at a time."""
    batches = [frames[start : start + 8] for start in range(0, len(frames), 8)]
    made = [encoding.descriptor for batch in batches for encoding in encoder.encode_batch(batch)]
    return np.stack(made) if made else np.zeros((0, encoder.dimension), np.float32)


def assess(encoder: Encoder, tasks: Tasks) -> tuple[Calibration, dict[str, Any]]:
    """The calibration measured on the tasks, and the figures on them."""
    queries, references = descriptors(encoder, tasks.lip6.queries), descriptors(encoder, tasks.lip6.references)
    cameras = {
        "webcams": (tasks.webcams, descriptors(encoder, tasks.webcams.pictures)),
        "night": (tasks.night, descriptors(encoder, tasks.night.pictures)),
    }
    score = encoder.scores_from_inner_products
    walked = score(queries @ references.T)
    far = references[:DISTRACTORS]
    unrelated = score(cameras["webcams"][1] @ references.T)
    start = UNCALIBRATED.model_copy(
        update={
            "background_mean": round(float(unrelated.mean()), 5),
            "background_deviation": round(float(unrelated.std()), 5),
        }
    )

    def all_trials(calibration: Calibration) -> dict[str, Trials]:
        made = {"lip6": walk_trials(tasks.lip6, walked, calibration)}
        for name, (task, shown) in cameras.items():
            made[name] = camera_trials(task, score(shown @ shown.T), score(shown @ far.T), calibration)
        return made

    outcomes = all_trials(start)
    calibration = choose(list(outcomes.values()), start)
    best = walked.argmax(axis=1)
    figures: dict[str, Any] = {
        "lip6_recall_at_1": float(tasks.lip6.truth[np.arange(len(best)), best].mean()),
        "verdicts": {name: rates(outcome, calibration) for name, outcome in outcomes.items()},
    }
    for name, (task, shown) in cameras.items():
        figures[f"{name}_recall_at_1"] = camera_recall(task, shown, far)
    return calibration, figures


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
    save_network(output / f"{NETWORK}{NETWORK_SUFFIX}", student_definition(), tensors)
    pictures, tasks = vocabulary_pictures(datasets, images, seed), load_tasks(datasets)
    for name, definition in PRESETS.items():
        encoder, vocabulary = build(name, definition, tensors, pictures, seed)
        calibration, figures = assess(encoder, tasks)
        encoder.calibration = calibration
        training = {"images": len(pictures), "seed": seed, "source": "training photographs, see MODEL_CARD.md"}
        save_encoder(output, encoder, vocabulary, NETWORK, training)
        typer.echo(
            json.dumps({"encoder": encoder.identity, "calibration": calibration.model_dump(), **figures}, indent=2)
        )


if __name__ == "__main__":
    typer.run(main)
