"""``placerec vocabulary``: training encoders on images of one's own."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import typer
from numpy.typing import NDArray

from core.disk.files import replacing
from lab.commands.making import MOST_IMAGES, install_described, split
from lab.commands.model import check_free_name
from service.commands.console import Commands, Failure, progress, say
from service.commands.encoders.models import ModelsDir, models_directory
from service.commands.encoders.pictures import FEWEST_IMAGES, find_images, measured, read_images

if TYPE_CHECKING:
    from core.frames.preprocessing import Pixels
    from core.method.features import FeatureExtractor

vocabulary = typer.Typer(cls=Commands, help="Train vocabularies for encoders of your own.", no_args_is_help=True)

CAFFE_STEP = 1.0
"""Quantisation step for activations of Caffe's scale, tens to hundreds (method, section 3)."""


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
    limit: Annotated[
        int, typer.Option(min=FEWEST_IMAGES, help="Draw this many if there are more images.")
    ] = MOST_IMAGES,
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Replace an installed encoder of this name, if no map needs it any more."),
    ] = False,
    models_dir: ModelsDir = None,
) -> None:
    """Train a vocabulary on a set of images and install the encoder that it makes.

    A network with a description says itself how it is aggregated; only the images, the seed and the limit count for it.
    Four images in five train, the fifth is held out to set threshold and margin of the verdict.
    """
    # Imported here because they take a second.
    from pydantic import ValidationError

    from core.method.catalogue import save_encoder
    from core.method.encoder import Encoder, EncoderDefinition
    from core.method.features import FeatureExtractor
    from core.method.vocabulary import pool_features, train_vocabulary
    from core.networks.network import load_network
    from core.networks.onnx_network import is_onnx_network
    from core.recognition.encoder_calibration import UNMEASURED

    chosen = split(find_images(images), limit, seed)
    folder = models_directory(models_dir)
    check_free_name(folder, name, "encoder", overwrite)
    network_name, network_file = _find_network(network, folder)
    if is_onnx_network(network_file):
        _install_network(network_name, network_file, folder)
        found = install_described(folder, name, network_name, network_file, chosen, seed)
        say(f"{found.identity}\ninstalled in {folder}")
        return
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
        frames = (_features(extractor, pixels) for pixels in bar.track(read_images(chosen.train), task_id=reading))
        features = pool_features(frames, seed)
        clustering = bar.add_task(f"k-means, {words} words", total=None)
        made = train_vocabulary(features, words, seed, extractor.origin)
        bar.update(clustering, total=1, completed=1)
    encoder = Encoder(name, extractor, definition, made, UNMEASURED)
    encoder.calibration = measured(encoder, chosen.held_out)
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
    say(f"{encoder.identity}\ninstalled in {folder}")


def _find_network(given: str, folder: Path) -> tuple[str, Path]:
    from core.method.catalogue import EncoderCatalogue
    from core.networks.files import network_name

    if given.endswith(".safetensors") or os.sep in given:
        return network_name(Path(given)), Path(given)
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


def _features(extractor: FeatureExtractor, pixels: Pixels) -> NDArray[np.float32]:
    return extractor.regions(extractor.activations([pixels])[0]).features
