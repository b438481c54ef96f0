"""``placerec vocabulary``: training encoders on images of one's own."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import Progress, TaskID

from core.disk.files import replacing
from core.errors import InvalidImage
from core.frames.traverses import SUPPORTED_SUFFIXES, natural_key
from service.commands.connection.client import read_bytes
from service.commands.console import Commands, Failure, messages, output, progress, remark
from service.commands.model import ModelsDir, check_free_name, models_directory

if TYPE_CHECKING:
    from core.frames.preprocessing import Pixels
    from core.judgement.verdict import Calibration
    from core.method.encoder import EncoderDefinition
    from core.method.features import FeatureExtractor
    from core.method.vocabulary import Vocabulary

vocabulary = typer.Typer(cls=Commands, help="Train vocabularies for encoders of your own.", no_args_is_help=True)

HELD_OUT = 5
"""One image in so many is held out of training and calibrates the verdict."""

FEWEST_IMAGES = 30
NEIGHBOURS = 3
"""Held-out images up to so many places apart may show the same place."""

MOST_HELD_OUT = 400
CAFFE_STEP = 1.0
"""Quantisation step for activations of Caffe's scale, tens to hundreds (method, section 3)."""


@dataclass(frozen=True)
class Split:
    """Images to learn from and images to measure with, in natural order."""

    train: list[Path]
    held_out: list[Path]


@vocabulary.callback()
def _group() -> None:
    """Keep ``train`` a subcommand while it is the only one."""


@vocabulary.command()
def train(
    images: Annotated[
        list[Path], typer.Argument(metavar="IMAGES…", help="Images, or directories with all below them.")
    ],
    name: Annotated[str, typer.Option(help="Name of the new encoder.", show_default=False)],
    network: Annotated[
        str, typer.Option(metavar="NAME|FILE", help="Network to take regions from.")
    ] = "placerec-hybrid",
    layers: Annotated[str, typer.Option(help="Layers to fuse.")] = "conv3,conv4",
    regions: Annotated[int, typer.Option(min=1, max=10_000, help="N, regions of each layer.")] = 300,
    words: Annotated[int, typer.Option(min=1, max=65_536, help="V, words of the vocabulary.")] = 128,
    step: Annotated[
        str | None,
        typer.Option(
            help="Quantisation step, one for all layers or one each; default: that of the packaged encoder "
            "for its network, 1.0 for others.",
            show_default=False,
        ),
    ] = None,
    unit_features: Annotated[
        bool,
        typer.Option(
            "--unit-features/--raw", help="Scale each regional feature to unit length, which the thesis does not."
        ),
    ] = True,
    gamma: Annotated[float, typer.Option(min=0.01, max=1.0, help="Exponent of the power normalisation.")] = 0.5,
    normalization: Annotated[Literal["intra", "global"], typer.Option(help="Of the VLAD.")] = "intra",
    seed: Annotated[
        int, typer.Option(min=0, max=2**31 - 1, help="The same seed and images give the same vocabulary.")
    ] = 0,
    limit: Annotated[int, typer.Option(min=FEWEST_IMAGES, help="Draw this many if there are more images.")] = 3000,
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Replace an installed encoder of this name, if no map needs it any more."),
    ] = False,
    models_dir: ModelsDir = None,
) -> None:
    """Train a vocabulary on a set of images and install the encoder that it makes.

    Four images in five train, the fifth is kept out to set threshold and margin of the verdict.
    """
    # Imported here because they take a second.
    from pydantic import ValidationError

    from core.method.catalogue import save_encoder
    from core.method.encoder import Encoder, EncoderDefinition
    from core.method.features import FeatureExtractor
    from core.method.vocabulary import pool_features, train_vocabulary
    from core.networks.network import load_network

    chosen = _split(_find(images), limit, seed)
    folder = models_directory(models_dir)
    check_free_name(folder, name, "encoder", overwrite)
    network_name, network_file = _find_network(network, folder)
    layer_names = tuple(part.strip() for part in layers.split(","))
    try:
        definition = EncoderDefinition(
            layers=layer_names,
            regions=regions,
            steps=_steps(step, network_name, layer_names),
            unit_features=unit_features,
            words=words,
            gamma=gamma,
            normalization=normalization,
        )
    except ValidationError as error:
        raise Failure(f"The encoder cannot be made: {error.errors()[0]['msg']}.") from error
    extractor = FeatureExtractor(load_network(network_file, layer_names), definition)
    with progress() as bar:
        reading = bar.add_task("Regions", total=len(chosen.train))
        frames = (_features(extractor, pixels) for _, pixels in _read(chosen.train, bar, reading))
        features = pool_features(frames, seed)
        clustering = bar.add_task(f"k-means, {words} words", total=None)
        made = train_vocabulary(features, words, seed, extractor.origin)
        bar.update(clustering, total=1, completed=1)
        calibration = _calibrate(name, extractor, definition, made, chosen.held_out, bar)
    encoder = Encoder(name, extractor, definition, made, calibration)
    training = {
        "images": len(chosen.train),
        "held_out": len(chosen.held_out),
        "features": len(features),
        "seed": seed,
    }
    try:
        _install_network(network_name, network_file, folder)
        save_encoder(folder, encoder, made, network_name, training)
    except OSError as error:
        raise Failure(f"{folder} cannot be written: {error.strerror or error}.") from error
    output.print(f"{encoder.identity}\ninstalled in {folder}", soft_wrap=True, highlight=False)


def _find(given: Sequence[Path]) -> list[Path]:
    """All images among and below the paths, in natural order."""
    found: set[Path] = set()
    for path in given:
        inside = path.rglob("*") if path.is_dir() else [path]
        images = {image for image in inside if image.suffix.lower() in SUPPORTED_SUFFIXES and image.is_file()}
        if not images:
            raise Failure(f"{path} is no image and holds none.")
        found |= images
    if len(found) < FEWEST_IMAGES:
        raise Failure(f"{len(found)} images are too few for a vocabulary; give at least {FEWEST_IMAGES}.")
    return sorted(found, key=lambda path: natural_key(str(path)))


def _split(paths: list[Path], limit: int, seed: int) -> Split:
    if len(paths) > limit:
        remark(f"{limit} of {len(paths)} images are drawn (--limit).")
        drawn = np.random.default_rng(seed).choice(len(paths), limit, replace=False)
        paths = [paths[index] for index in sorted(drawn)]
    held_out = paths[HELD_OUT - 1 :: HELD_OUT][:MOST_HELD_OUT]
    kept = set(held_out)
    return Split([path for path in paths if path not in kept], held_out)


def _find_network(given: str, folder: Path) -> tuple[str, Path]:
    from core.method.catalogue import EncoderCatalogue
    from core.networks.network import read_definition

    if given.endswith(".safetensors") or os.sep in given:
        return read_definition(Path(given)).name, Path(given)
    return given, EncoderCatalogue(folder).network_file(given)


def _install_network(name: str, file: Path, folder: Path) -> None:
    """Install a network that was given as a file, so that the encoder finds it."""
    from core.method.catalogue import NETWORK_SUFFIX, PACKAGED

    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{name}{NETWORK_SUFFIX}"
    if file.resolve().parent == PACKAGED.resolve() or (target.exists() and target.samefile(file)):
        return
    if target.exists() and target.read_bytes() != file.read_bytes():
        raise Failure(f"{target} is another network of the same name.")
    with replacing(target) as temporary:
        shutil.copyfile(file, temporary)


def _steps(text: str | None, network: str, layers: tuple[str, ...]) -> tuple[float, ...]:
    from core.method.presets import NETWORK, PRESETS

    if text is None:
        default = PRESETS["m-region-vlad"].steps[0] if network == NETWORK else CAFFE_STEP
        return (default,) * len(layers)
    try:
        steps = tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise typer.BadParameter(f"--step {text!r} is not a number, or one for each layer") from error
    return steps * len(layers) if len(steps) == 1 else steps


def _read(paths: Sequence[Path], bar: Progress, task: TaskID) -> Iterator[tuple[Path, Pixels]]:
    """The images that can be decoded; the others are named in a message."""
    from core.frames.images import decode

    for path in paths:
        try:
            yield path, decode(read_bytes(path))
        except InvalidImage as error:
            messages.print(f"{path} is left out: {error}", soft_wrap=True, markup=False, highlight=False)
        bar.advance(task)


def _features(extractor: FeatureExtractor, pixels: Pixels) -> NDArray[np.float32]:
    return extractor.regions(extractor.activations([pixels])[0]).features


def _calibrate(
    name: str,
    extractor: FeatureExtractor,
    definition: EncoderDefinition,
    made: Vocabulary,
    paths: Sequence[Path],
    bar: Progress,
) -> Calibration:
    from core.frames.preprocessing import second_look
    from core.judgement.calibration import fit_encoder_calibration
    from core.judgement.verdict import Calibration
    from core.method.encoder import Encoder

    nothing = Calibration(source="encoder-default", threshold=0, margin=0, background_mean=0, background_deviation=1)
    encoder = Encoder(name, extractor, definition, made, nothing)
    task = bar.add_task("Threshold and margin", total=len(paths))
    looks = [
        (encoder.encode(pixels).descriptor, encoder.encode(second_look(pixels)).descriptor)
        for _, pixels in _read(paths, bar, task)
    ]
    if len(looks) <= NEIGHBOURS + 1:
        raise Failure(f"Only {len(looks)} of the images kept out can be decoded; give more images.")
    first, second = (np.stack(side) for side in zip(*looks, strict=True))  # n x D
    score = encoder.scores_from_inner_products
    return fit_encoder_calibration(score(first @ first.T), score(second @ first.T), NEIGHBOURS, "encoder-default")
