"""What commands that work on models without the service share: the catalogue, decoded images."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from core.errors import InvalidImage
from service.commands.connection.client import read_bytes, read_settings
from service.commands.console import Failure

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
    """The encoder that is meant where none is named."""
    return read_settings().encoder


def name_of(identity: str) -> str:
    """The name in an encoder identity, ``<name>@<sha256>``."""
    return identity.partition("@")[0]


def load_image(path: Path) -> Pixels:
    """The pixels of an image file.

    Raises:
        Failure: it cannot be read or decoded; the text names the file.
    """
    from core.frames.images import decode

    try:
        return decode(read_bytes(path))
    except InvalidImage as error:
        raise Failure(f"{path}: {error}") from error


def check_free_name(folder: Path, name: str, kind: Literal["encoder", "network"], overwrite: bool) -> None:
    """See that a new encoder or network may have a name.

    Raises:
        Failure: it cannot name one, a packaged one has it, or an installed one that is not to be overwritten.
    """
    from core.method.catalogue import ENCODER_SUFFIX, NETWORK_SUFFIX, PACKAGED
    from core.networks.network import NAME

    if not re.fullmatch(NAME, name):
        raise Failure(f"{name!r} cannot name an {kind}: it must match {NAME}.")
    file = name + (ENCODER_SUFFIX if kind == "encoder" else NETWORK_SUFFIX)
    if (PACKAGED / file).exists():
        raise Failure(f"{name!r} is the name of a packaged {kind}; choose another.")
    if (folder / file).exists() and not overwrite:
        raise Failure(f"There is already a file {folder / file}; --overwrite replaces it.")
