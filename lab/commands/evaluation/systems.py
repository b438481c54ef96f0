"""``placerec evaluate``: choosing the systems, and listing all of them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.box import HEAVY_HEAD

from service.commands.console import output, show, table
from service.commands.encoders.models import ModelsDir, default_encoder, name_of, open_catalogue

if TYPE_CHECKING:
    from core.method.catalogue import EncoderCatalogue
    from core.recognition.question import Verify
    from lab.baselines.system import About, System

SYSTEMS = "Systems"
"""Their panel in the help."""

_option = partial(typer.Option, rich_help_panel=SYSTEMS)


@dataclass(frozen=True)
class SystemOptions:
    """The systems that are compared, and what they are made of."""

    encoder: Annotated[
        list[str] | None,
        _option(
            metavar="NAME",
            help="Encoder (name or identity) or system (name); may be repeated. Default: the service's encoder.",
        ),
    ] = None
    verify: Annotated[
        Literal["auto", "always", "never"],
        _option(
            help="When the geometry of the best matches is verified, as of a query to the service: where the scores "
            "leave doubt, always, or never. It holds for encoders of two stages whose name says nothing of stages.",
        ),
    ] = "auto"
    every: Annotated[bool, _option("--all", help="All systems that need no weights file, or whose file is given.")] = (
        False
    )
    weights: Annotated[
        list[str] | None, _option(metavar="NAME=FILE", help="The weights file of a system; may be repeated.")
    ] = None
    training: Annotated[
        Path | None,
        _option(
            metavar="DIR",
            help="Images (subdirectories included) for systems that learn. Default: the retained references.",
        ),
    ] = None
    models_dir: ModelsDir = None
    listed: Annotated[bool, _option("--list", help="List systems and data sets, and do nothing else.")] = False

    @property
    def keyframe_encoder(self) -> str | None:
        """The encoder by which keyframes are chosen: the first; None for the default."""
        return self.encoder[0] if self.encoder else None

    def weights_files(self) -> dict[str, Path]:
        """The weights files by name, as :func:`parse_weights`."""
        return parse_weights(self.weights or [])

    def build(self) -> list[System]:
        """The systems, as :func:`build_systems`."""
        catalogue = open_catalogue(self.models_dir)
        return build_systems(self.encoder or [], self.every, self.weights_files(), catalogue, self.verify)


def parse_weights(given: list[str]) -> dict[str, Path]:
    """``NAME=FILE`` by name.

    Raises:
        typer.BadParameter: one is something else, or a name stands twice.
    """
    files: dict[str, Path] = {}
    for text in given:
        found = re.fullmatch(r"([^=]+)=(.+)", text)
        if found is None or found[1] in files:
            raise typer.BadParameter(f"--weights {text!r} is not NAME=FILE, each name once")
        files[found[1]] = Path(found[2])
    return files


def build_systems(
    names: list[str], every: bool, weights: dict[str, Path], models: EncoderCatalogue, verify: Verify = "auto"
) -> list[System]:
    """The systems that the options name, each once, in that order.

    Args:
        names: of systems or encoders; if empty, the default encoder.
        every: add all systems that run without a file, or whose file is given.
        verify: when encoders verify, if they are queried as by the service.

    Raises:
        MissingWeights, UnknownEncoder, InvalidModel: one cannot be made.
        typer.BadParameter: a file is given for a system that is not among them.
    """
    from lab.baselines.registry import build, systems

    requested = list(names)
    if every:
        damaged = {summary.name for summary in models.describe() if summary.damaged is not None}
        requested += [
            about.name
            for about in systems(models)
            if about.name not in damaged and (about.weights is None or about.name in weights)
        ]
    requested = list(dict.fromkeys(requested or [default_encoder()]))
    idle = weights.keys() - {name_of(name) for name in requested}
    if idle:
        raise typer.BadParameter(f"--weights for {', '.join(sorted(idle))}, which --encoder does not name")
    built: dict[str, System] = {}
    for name in requested:
        system = build(name, models=models, weights=weights.get(name), verify=verify)
        built.setdefault(system.about.name, system)
    return list(built.values())


def show_list(models: EncoderCatalogue) -> None:
    """Write name, paper, configuration and weights of all systems, then the data sets."""
    from lab.baselines.registry import systems
    from lab.evaluation.data.presets import DATASETS

    shown = table("name", "system and paper", "configuration", "weights", title="Systems, for --encoder")
    if output.is_terminal:  # there a system takes many lines; elsewhere one, which can be searched
        shown.box, shown.show_lines, shown.pad_edge = HEAVY_HEAD, True, True
    for column in shown.columns:
        column.overflow, column.no_wrap = "fold", column.header == "name"
    for about in systems(models):
        needed = "none" if about.weights is None else f"--weights {about.name}=FILE: {about.weights}"
        shown.add_row(about.name, f"{about.title}. {about.paper}", _configuration(about), needed)
    show(shown)
    columns = ("name", "data set", "references", "queries", "true", "left out", "protocol of")
    sets = table(*columns, title="Data sets, for --dataset")
    for dataset in DATASETS:
        sides = [names[0] if names else "the frames" for names in (dataset.references, dataset.queries)]
        sets.add_row(dataset.name, dataset.title, *sides, dataset.truth, dataset.excluded, dataset.source)
    show(sets)


def _configuration(about: About) -> str:
    return ", ".join(f"{name} {_value(value)}" for name, value in about.configuration.items())


def _value(value: object) -> str:
    return "/".join(map(str, value)) if isinstance(value, tuple) else str(value)
