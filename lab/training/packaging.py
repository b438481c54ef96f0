"""Turns distilled weights into the packaged encoders: vocabularies, calibration, golden values, files.

With ``--only``, it makes some of the encoders anew for the network that is packaged already, and leaves the rest; with
``--second-stage`` these keep their projections and vocabularies, so that their descriptors stay as they are.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import torch
import typer
from rich.progress import track
from safetensors.torch import load_file
from torch import Tensor

from core.frames.preprocessing import Pixels
from core.method.catalogue import ENCODER_SUFFIX, NETWORK_SUFFIX, PACKAGED, load_encoder, save_encoder
from core.method.encoder import Encoder, EncoderDefinition
from core.method.features import FeatureExtractor
from core.method.presets import NETWORK, PRESETS
from core.method.vocabulary import Vocabulary, pool_features, train_vocabulary
from core.networks.network import save_network
from core.networks.torch_network import TorchNetwork, arrays_of
from lab.training.default_calibration import UNCALIBRATED, assess, for_small_maps
from lab.training.photographs import read, split_photographs
from lab.training.projections import fit_cell_projections, fit_projections
from lab.training.student import student_definition
from lab.training.validation import load_tasks

VOCABULARY_IMAGES = 2600  # as many as the thesis pools for its vocabularies


def vocabulary_pictures(datasets: Path, count: int, seed: int) -> list[Pixels]:
    """A random choice of the training photographs."""
    paths = split_photographs(datasets / "train").train
    chosen = np.random.default_rng(seed).choice(len(paths), min(count, len(paths)), replace=False)
    return [read(paths[index]) for index in sorted(chosen)]


def network_of(weights: dict[str, Tensor], layers: Sequence[str], size: tuple[int, int] | None = None) -> TorchNetwork:
    """The distilled backbone as deep as ``layers`` needs, for an input of its own or of another height and width."""
    definition = student_definition()
    if size is not None:
        shown = definition.input.model_copy(update={"height": size[0], "width": size[1]})
        definition = definition.model_copy(update={"input": shown})
    network = TorchNetwork(definition, layers)
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
    plain = _untaught(definition)
    extractor = FeatureExtractor(network.as_data(), plain, projections)
    frames = (
        extractor.regions(extractor.activations([picture])[0]).features
        for picture in track(pictures, f"features for {name}")
    )
    vocabulary = train_vocabulary(pool_features(frames, seed), definition.words, seed, extractor.origin)
    encoder = Encoder(name, extractor, plain, vocabulary, UNCALIBRATED)
    return taught(encoder, definition, photographs, seed), vocabulary


def _untaught(definition: EncoderDefinition) -> EncoderDefinition:
    """The same with cells in the projections of the regions."""
    stage = definition.agreement
    if stage is None or not stage.taught:
        return definition
    return definition.model_copy(update={"agreement": stage.model_copy(update={"taught": None})})


def taught(encoder: Encoder, definition: EncoderDefinition, photographs: Path, seed: int) -> Encoder:
    """The encoder as defined, with projections of its cells fitted to ``photographs`` if they are taught."""
    stage, extractor = definition.agreement, encoder.extractor
    if stage is None or not stage.taught:
        return encoder
    cells = fit_cell_projections(encoder, stage, photographs, seed=seed)
    vocabulary = Vocabulary(encoder.centers, extractor.origin)
    extractor = FeatureExtractor(extractor.backbone, definition, extractor.projections, cells)
    return Encoder(encoder.name, extractor, definition, vocabulary, encoder.calibration)


def with_second_stage(
    name: str, definition: EncoderDefinition, weights: dict[str, Tensor], folder: Path, photographs: Path, seed: int
) -> tuple[Encoder, Vocabulary]:
    """The encoder of a folder with a second stage as defined, not yet calibrated; the first stays as it is.

    Projections of cells that are taught are fitted to ``photographs``.

    Raises:
        WrongVocabulary: the definition changes the first stage, too.
    """
    retained = load_encoder(folder / f"{name}{ENCODER_SUFFIX}", folder / f"{NETWORK}{NETWORK_SUFFIX}")
    plain = _untaught(definition)
    extractor = FeatureExtractor(network_of(weights, plain.outputs).as_data(), plain, retained.extractor.projections)
    vocabulary = Vocabulary(retained.centers, retained.extractor.origin)
    encoder = Encoder(name, extractor, plain, vocabulary, UNCALIBRATED)
    return taught(encoder, definition, photographs, seed), vocabulary


def main(
    weights: Annotated[Path, typer.Option(help="Folded weights of the distillation.")] = Path(
        "runs/distillation/weights.safetensors"
    ),
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    output: Annotated[Path, typer.Option(help="Where the model files go.")] = PACKAGED,
    images: Annotated[int, typer.Option(min=1, help="Photographs for the vocabularies.")] = VOCABULARY_IMAGES,
    seed: int = 0,
    only: Annotated[
        list[str] | None, typer.Option(help="Just these presets, of the network in the output folder.")
    ] = None,
    second_stage: Annotated[
        bool, typer.Option("--second-stage", help="Of these presets just the second stage; the first stays.")
    ] = False,
) -> None:
    """Write the network and one encoder file for each preset, and print what they reach."""
    unknown = set(only or ()) - PRESETS.keys()
    if unknown:
        raise typer.BadParameter(f"no preset is named {', '.join(sorted(unknown))}; there are {', '.join(PRESETS)}")
    if second_stage and not only:
        raise typer.BadParameter("a second stage is added to the encoders that --only names")
    torch.manual_seed(seed)
    output.mkdir(parents=True, exist_ok=True)
    network = f"{NETWORK}{NETWORK_SUFFIX}"
    tensors = load_file(output / network if only else weights)
    pictures = [] if second_stage else vocabulary_pictures(datasets, images, seed)
    tasks = load_tasks(datasets)
    # The encoders of one network go with it, so all files change together, at the end.
    with TemporaryDirectory(dir=output, prefix="unfinished-") as unfinished:
        folder = Path(unfinished)
        if not only:
            save_network(folder / network, student_definition(), arrays_of(tensors))
        for name in only or PRESETS:
            definition = PRESETS[name]
            if second_stage:
                encoder, vocabulary = with_second_stage(name, definition, tensors, output, datasets / "train", seed)
            else:
                encoder, vocabulary = build(name, definition, tensors, datasets / "train", pictures, seed)
            calibration, figures = assess(encoder, tasks)
            calibration = encoder.calibration = for_small_maps(encoder, datasets, calibration)
            source = "training photographs, see MODEL_CARD.md"
            training = {"images": len(pictures) or images, "seed": seed, "source": source}
            save_encoder(folder, encoder, vocabulary, NETWORK, training)
            made = {"encoder": encoder.identity, "calibration": calibration.model_dump(), **figures}
            typer.echo(json.dumps(made, indent=2))
        for path in sorted(folder.iterdir()):
            os.replace(path, output / path.name)


if __name__ == "__main__":
    typer.run(main)
