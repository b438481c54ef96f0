"""``placerec model``: networks that were trained elsewhere."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal, cast

import typer

from core.disk.files import replacing
from service.commands.console import Commands, Failure, remark, say, show, table
from service.commands.encoders.models import ModelsDir, models_directory

model = typer.Typer(cls=Commands, help="Import networks that were trained elsewhere.", no_args_is_help=True)


@model.callback()
def _group() -> None:
    """Keep ``import`` a subcommand while it is the only one."""


@model.command("import")
def import_model(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help=".onnx or .caffemodel.", show_default=False),
    ],
    name: Annotated[
        str | None, typer.Option(help="Name to install the network under. Default: the preset's.", show_default=False)
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="The published network that FILE.onnx is: it sets input, output and aggregation.", show_default=False
        ),
    ] = None,
    description: Annotated[
        Path | None, typer.Option(metavar="FILE", help="In place of a preset: the description of FILE.onnx, .json.")
    ] = None,
    images: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="PATH",
            help="With a preset or a description: pictures that teach and calibrate the encoder; may be repeated.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the training from the pictures.")] = 0,
    mean: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A Caffe network's mean file, .npy or .binaryproto.", show_default=False),
    ] = None,
    input_size: Annotated[
        str | None,
        typer.Option(metavar="WIDTHxHEIGHT", help="Size of its input. Default: the size in the file, or the preset's."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an installed network of this name, and its encoder.")
    ] = False,
    models_dir: ModelsDir = None,
) -> None:
    """Install a network that was trained elsewhere; its weights stay as they are.

    A .caffemodel becomes a network that vocabularies can be trained for.  An .onnx file with a preset or a description
    becomes an encoder as well; at once if nothing has to be learned for it, else with --images.
    """
    # Imported here because they take a second.
    from lab.conversion.presets import PRESETS

    if preset is not None and preset not in PRESETS:
        raise typer.BadParameter(f"--preset {preset!r} is not one of {', '.join(PRESETS)}")
    if preset is not None and description is not None:
        raise typer.BadParameter("give --preset or --description")
    if (named := name or preset) is None:
        raise typer.BadParameter("--name is missing")
    folder = models_directory(models_dir)
    check_free_name(folder, named, "network", overwrite)
    if preset is None and description is None:
        if file.suffix.lower() == ".onnx":
            raise typer.BadParameter(f"--preset or --description says what goes into {file.name}, and what comes out")
        if images is not None:
            raise typer.BadParameter("--images needs --preset or --description; train a vocabulary afterwards")
        _import_caffe(file, mean, named, _size(input_size), folder)
        return
    check_free_name(folder, named, "encoder", overwrite)
    if mean is not None:
        raise typer.BadParameter("--mean belongs to a .caffemodel")
    _import_described(file, named, preset, description, _size(input_size), images, seed, folder)


def _import_described(
    file: Path,
    name: str,
    preset: str | None,
    description: Path | None,
    size: tuple[int, int] | None,
    images: list[Path] | None,
    seed: int,
    folder: Path,
) -> None:
    from core.method.catalogue import NETWORK_SUFFIX
    from core.networks.description import read_description
    from core.networks.onnx_network import save_onnx_network
    from lab.commands.making import MOST_IMAGES, install_described, split
    from lab.conversion.checkpoints import is_checkpoint
    from lab.conversion.onnx_import import import_onnx
    from lab.conversion.presets import PRESETS
    from service.commands.encoders.pictures import FEWEST_IMAGES, find_images

    described = PRESETS[preset] if preset is not None else read_description(cast(Path, description))
    described = described if size is None else described.at(*size)
    chosen = None if images is None else split(find_images(images, FEWEST_IMAGES), MOST_IMAGES, seed)
    if is_checkpoint(file):
        raise Failure(f"{file} is a checkpoint: its authors' code has to export the network to the ONNX format first.")
    graph = import_onnx(file, described)
    path = folder / f"{name}{NETWORK_SUFFIX}"
    _written(path, lambda temporary: save_onnx_network(temporary, name, graph, described))
    shown = described.input
    remark(f"{path} is written: input {shown.width}x{shown.height}, {described.output.kind}.")
    if described.learned and chosen is None:
        remark(f"Its encoder learns from pictures: placerec vocabulary train IMAGES… --network {name} --name {name}")
        return
    encoder = install_described(folder, name, name, path, chosen, seed)
    say(f"{encoder.identity}\ninstalled in {folder}")
    if chosen is None:
        remark(f"It calls every frame unknown until it is calibrated: placerec calibrate {name} --packaged IMAGES")


def _import_caffe(file: Path, mean: Path | None, name: str, size: tuple[int, int] | None, folder: Path) -> None:
    from core.method.catalogue import NETWORK_SUFFIX
    from core.networks.network import Convolution, save_network
    from core.networks.torch_network import arrays_of
    from lab.conversion.caffe import import_caffe

    definition, weights = import_caffe(file, mean, name=name, input_size=size)
    path = folder / f"{name}{NETWORK_SUFFIX}"
    _written(path, lambda temporary: save_network(temporary, definition, arrays_of(weights)))
    shown = definition.input
    means = ", ".join(f"{value:g}" for value in shown.mean)
    rows = table("layer", "type", "parameters", title=f"{name}: input {shown.width}x{shown.height}, mean {means}")
    for layer in definition.layers:
        values = layer.model_dump(exclude={"name", "type"}, exclude_defaults=not isinstance(layer, Convolution))
        rows.add_row(layer.name, layer.type, " ".join(f"{key}={value}" for key, value in values.items()))
    show(rows)
    remark(f"{path} is written. Next: placerec vocabulary train IMAGES… --network {name} --name ENCODER")


def _written(path: Path, save: Callable[[Path], None]) -> None:
    """Write a network's file, whole or not at all."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            save(temporary)
            temporary.chmod(0o644)
    except OSError as error:
        raise Failure(f"{path} cannot be written: {error.strerror or error}.") from error


def _size(text: str | None) -> tuple[int, int] | None:
    """Height and width, as the importer wants them."""
    if text is None:
        return None
    found = re.fullmatch(r"([0-9]{2,4})(?:[xX×]([0-9]{2,4}))?", text)
    if found is None:
        raise typer.BadParameter(f"--input-size {text!r} is not WIDTHxHEIGHT in pixels")
    width = int(found[1])
    return int(found[2] or width), width


def check_free_name(folder: Path, name: str, kind: Literal["encoder", "network"], overwrite: bool) -> None:
    """Check that a new encoder or network may have a name.

    Raises:
        InvalidIdentifier: it cannot name one.
        Failure: a packaged one has it, or an installed one that is not to be overwritten.
    """
    from core.method.catalogue import ENCODER_SUFFIX, NETWORK_SUFFIX, PACKAGED
    from core.names import file_names

    file_names("an encoder" if kind == "encoder" else "a network").check(name)
    file = name + (ENCODER_SUFFIX if kind == "encoder" else NETWORK_SUFFIX)
    if (PACKAGED / file).exists():
        raise Failure(f"{name!r} is the name of a packaged {kind}; choose another.")
    if (folder / file).exists() and not overwrite:
        raise Failure(f"There is already a file {folder / file}; --overwrite replaces it.")
