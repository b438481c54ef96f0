"""The installed models, as commands use them, and pictures to try them on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from core.errors import InvalidImage
from service.commands.connection.client import read_bytes
from service.commands.console import Failure
from service.commands.options.settings import read_settings

if TYPE_CHECKING:
    from core.frames.preprocessing import Pixels
    from core.method.catalogue import EncoderCatalogue

ModelsDir = Annotated[
    Path | None,
    typer.Option("--models-dir", help="Directory of installed models; else PLACEREC_MODELS_DIR.", show_default=False),
]


def models_directory(chosen: Path | None) -> Path:
    """The directory of installed models: the chosen one, or that of the settings."""
    return read_settings().models_directory if chosen is None else chosen


def open_catalogue(models_dir: Path | None) -> EncoderCatalogue:
    """The packaged encoders and those of the directory."""
    from core.method.catalogue import EncoderCatalogue

    return EncoderCatalogue(models_directory(models_dir))


def default_encoder() -> str:
    """The encoder that the service uses where none is named."""
    return read_settings().encoder


def name_of(identity: str) -> str:
    """The name in an encoder identity, ``<name>@<sha256>``."""
    return identity.partition("@")[0]


def load_image(path: Path) -> Pixels:
    """The pixels of an image file of any format that OpenCV reads.

    Raises:
        Failure: it cannot be read or decoded; the text names the file.
    """
    from core.frames.images import decode
    from core.recordings.pictures import sendable

    try:
        return decode(sendable(read_bytes(path)))
    except InvalidImage as error:
        raise Failure(f"{path}: {error}") from error
