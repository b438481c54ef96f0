"""The pictures that a command is given, and the calibration of an encoder that is measured on them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from core.errors import InvalidImage
from core.frames.traverses import SUPPORTED_SUFFIXES, natural_key
from service.commands.connection.client import read_bytes
from service.commands.console import Failure, progress, remark

if TYPE_CHECKING:
    from core.frames.preprocessing import Pixels
    from core.judgement.verdict import Calibration
    from core.method.encoder import Encoder

FEWEST_IMAGES = 30
MOST_HELD_OUT = 400


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


def read_images(paths: Iterable[Path]) -> Iterator[Pixels]:
    """The images that can be decoded; the others are named in a message."""
    from core.frames.images import decode

    for path in paths:
        try:
            yield decode(read_bytes(path))
        except InvalidImage as error:
            remark(f"{path} is left out: {error}")


def measured(encoder: Encoder, paths: Sequence[Path]) -> Calibration:
    """The calibration of an encoder, measured on images."""
    from core.recognition.encoder_calibration import measure_calibration

    with progress() as bar:
        task = bar.add_task("Threshold and margin", total=len(paths))
        return measure_calibration(encoder, bar.track(read_images(paths), task_id=task), "encoder-default")
