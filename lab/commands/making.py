"""Encoders made of pictures: the pictures that teach, the pictures that measure, and the encoder's file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from service.commands.console import progress, remark
from service.commands.encoders.pictures import MOST_HELD_OUT, measured, read_images

if TYPE_CHECKING:
    from core.frames.preprocessing import Pixels
    from core.method.encoder import Encoder

HELD_OUT = 5
"""One image in this number is held out of training and calibrates the verdict."""

MOST_IMAGES = 3000


@dataclass(frozen=True)
class ImageSplit:
    """Images to learn from and images to measure with, in natural order."""

    train: list[Path]
    held_out: list[Path]


def split(paths: list[Path], limit: int, seed: int) -> ImageSplit:
    """Draw ``limit`` images if there are more, and hold one in five out."""
    if len(paths) > limit:
        remark(f"{limit} of {len(paths)} images are drawn (--limit).")
        drawn = np.random.default_rng(seed).choice(len(paths), limit, replace=False)
        paths = [paths[index] for index in sorted(drawn)]
    held_out = paths[HELD_OUT - 1 :: HELD_OUT][:MOST_HELD_OUT]
    calibrating = set(held_out)
    return ImageSplit([path for path in paths if path not in calibrating], held_out)


def install_described(
    folder: Path, name: str, network: str, network_file: Path, chosen: ImageSplit | None, seed: int
) -> Encoder:
    """Make and install the encoder that a network's own description asks for.

    Args:
        network, network_file: an imported network.
        chosen: None: nothing is learned, and the encoder has no measured calibration.
    """
    from core.method.catalogue import save_encoder
    from core.networks.onnx_network import load_onnx_network
    from lab.conversion.encoder_making import make_encoder

    taken = chosen or ImageSplit([], [])
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
