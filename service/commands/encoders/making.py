"""Encoders made of pictures, as commands make them: which pictures there are, which teach, and which measure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from core.errors import InvalidImage
from core.frames.traverses import SUPPORTED_SUFFIXES, natural_key
from service.commands.connection.client import read_bytes
from service.commands.console import Failure, messages, progress, remark

if TYPE_CHECKING:
    from core.frames.preprocessing import Pixels
    from core.judgement.verdict import Calibration
    from core.method.encoder import Encoder

HELD_OUT = 5
"""One image in so many is held out of training and calibrates the verdict."""

FEWEST_IMAGES = 30
MOST_HELD_OUT = 400
MOST_IMAGES = 3000


@dataclass(frozen=True)
class Split:
    """Images to learn from and images to measure with, in natural order."""

    train: list[Path]
    held_out: list[Path]


def find_images(given: Sequence[Path], fewest: int = FEWEST_IMAGES) -> list[Path]:
    """All images among and below the paths, in natural order.

    Raises:
        Failure: a path has none, or all have too few.
    """
    found: set[Path] = set()
    for path in given:
        inside = path.rglob("*") if path.is_dir() else [path]
        images = {image for image in inside if image.suffix.lower() in SUPPORTED_SUFFIXES and image.is_file()}
        if not images:
            raise Failure(f"{path} is no image and holds none.")
        found |= images
    if len(found) < fewest:
        raise Failure(f"{len(found)} images are too few for this; give at least {fewest}.")
    return sorted(found, key=lambda path: natural_key(str(path)))


def split(paths: list[Path], limit: int, seed: int) -> Split:
    """Draw ``limit`` images if there are more, and hold one in five out."""
    if len(paths) > limit:
        remark(f"{limit} of {len(paths)} images are drawn (--limit).")
        drawn = np.random.default_rng(seed).choice(len(paths), limit, replace=False)
        paths = [paths[index] for index in sorted(drawn)]
    held_out = paths[HELD_OUT - 1 :: HELD_OUT][:MOST_HELD_OUT]
    kept = set(held_out)
    return Split([path for path in paths if path not in kept], held_out)


def read_images(paths: Iterable[Path]) -> Iterator[Pixels]:
    """The images that can be decoded; the others are named in a message."""
    from core.frames.images import decode

    for path in paths:
        try:
            yield decode(read_bytes(path))
        except InvalidImage as error:
            messages.print(f"{path} is left out: {error}", soft_wrap=True, markup=False, highlight=False)


def measured(encoder: Encoder, paths: Sequence[Path]) -> Calibration:
    """The calibration of an encoder, measured on images."""
    from core.recognition.encoder_making import measure_calibration

    with progress() as bar:
        task = bar.add_task("Threshold and margin", total=len(paths))
        return measure_calibration(encoder, bar.track(read_images(paths), task_id=task), "encoder-default")


def install_described(
    folder: Path, name: str, network: str, network_file: Path, chosen: Split | None, seed: int
) -> Encoder:
    """Make and install the encoder that a network's own description asks for.

    Args:
        network, network_file: an imported network.
        chosen: None: nothing is learned, and the encoder has no measured calibration.
    """
    from core.method.catalogue import save_encoder
    from core.networks.imported.onnx_network import load_onnx_network
    from core.recognition.encoder_making import make_encoder

    taken = chosen or Split([], [])
    opened = load_onnx_network(network_file)
    with progress() as bar:

        def frames() -> Iterator[Pixels]:
            task = bar.add_task("Features", total=len(taken.train))
            yield from bar.track(read_images(taken.train), task_id=task)

        encoder, vocabulary = make_encoder(name, opened, frames, seed)
    if chosen is not None:
        encoder.calibration = measured(encoder, chosen.held_out)
    learned = {"images": len(taken.train), "held_out": len(taken.held_out), "seed": seed}
    citation = {"network": opened.description.citation} if opened.description.citation else {}
    save_encoder(folder, encoder, vocabulary, network, learned | citation)
    return encoder
