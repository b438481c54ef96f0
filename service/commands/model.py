"""``placerec model``: networks that were trained elsewhere; and the installed models, as other commands use them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from core.disk.files import replacing
from core.errors import InvalidImage
from service.commands.connection.client import read_bytes, read_settings
from service.commands.console import Commands, Failure, remark, show, table

if TYPE_CHECKING:
    from core.frames.preprocessing import Pixels
    from core.method.catalogue import EncoderCatalogue

model = typer.Typer(cls=Commands, help="Import networks that were trained elsewhere.", no_args_is_help=True)

ModelsDir = Annotated[
    Path | None,
    typer.Option("--models-dir", help="Directory of installed models; else PLACEREC_MODELS_DIR.", show_default=False),
]


@model.callback()
def _group() -> None:
    """Keep ``import`` a subcommand while it is the only one."""


@model.command("import")
def import_model(
    file: Annotated[Path, typer.Argument(metavar="FILE.caffemodel", help="A Caffe network.", show_default=False)],
    name: Annotated[str, typer.Option(help="Name to install the network under.", show_default=False)],
    mean: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The network's mean file, .npy or .binaryproto.", show_default=False),
    ] = None,
    input_size: Annotated[
        str | None,
        typer.Option(metavar="WIDTHxHEIGHT", help="Size of its input. Default: the size in the file."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an installed network of this name.")] = False,
    models_dir: ModelsDir = None,
) -> None:
    """Install a .caffemodel as a network that vocabularies can be trained for; its weights are kept as they are."""
    # Imported here because they take a second.
    from core.method.catalogue import NETWORK_SUFFIX
    from core.networks.caffe import import_caffe
    from core.networks.network import Convolution, save_network

    folder = models_directory(models_dir)
    check_free_name(folder, name, "network", overwrite)
    definition, weights = import_caffe(file, mean, name=name, input_size=_size(input_size))
    path = folder / f"{name}{NETWORK_SUFFIX}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            save_network(temporary, definition, weights)
            temporary.chmod(0o644)
    except OSError as error:
        raise Failure(f"{path} cannot be written: {error.strerror or error}.") from error

    shown = definition.input
    means = ", ".join(f"{value:g}" for value in shown.mean)
    rows = table("layer", "type", "parameters", title=f"{name}: input {shown.width}x{shown.height}, mean {means}")
    for layer in definition.layers:
        values = layer.model_dump(exclude={"name", "type"}, exclude_defaults=not isinstance(layer, Convolution))
        rows.add_row(layer.name, layer.type, " ".join(f"{key}={value}" for key, value in values.items()))
    show(rows)
    remark(f"{path} is written. Next: placerec vocabulary train IMAGES… --network {name} --name ENCODER")


def _size(text: str | None) -> tuple[int, int] | None:
    """Height and width, as the importer wants them."""
    if text is None:
        return None
    found = re.fullmatch(r"([0-9]{2,4})(?:[xX×]([0-9]{2,4}))?", text)
    if found is None:
        raise typer.BadParameter(f"--input-size {text!r} is not WIDTHxHEIGHT in pixels")
    width = int(found[1])
    return int(found[2] or width), width


# Installed models


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


def check_free_name(folder: Path, name: str, kind: Literal["encoder", "network"], overwrite: bool) -> None:
    """Check that a new encoder or network may have a name.

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
