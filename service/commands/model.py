"""``placerec model``: networks that were trained elsewhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from core.disk.files import replacing
from service.commands.console import Commands, Failure, remark, show, table
from service.commands.models import ModelsDir, check_free_name, models_directory

model = typer.Typer(cls=Commands, help="Import networks that were trained elsewhere.", no_args_is_help=True)


@model.callback()
def _group() -> None:
    """Keeps ``import`` a command of its own while it is the only one."""


@model.command("import")
def import_model(
    file: Annotated[Path, typer.Argument(metavar="FILE.caffemodel", help="A Caffe network.", show_default=False)],
    name: Annotated[str, typer.Option(help="Name of the network here.", show_default=False)],
    mean: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Its mean file, .npy or .binaryproto.", show_default=False)
    ] = None,
    input_size: Annotated[
        str | None,
        typer.Option(metavar="WIDTHxHEIGHT", help="Size of its input; default: what the model says."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an installed network of this name.")] = False,
    models_dir: ModelsDir = None,
) -> None:
    """Turn a .caffemodel into a network that vocabularies can be trained for; no weight is changed."""
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
