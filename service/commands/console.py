"""What all commands share: where they write, how they fail, how they show progress."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from core.disk.files import write_file as write_durably
from core.errors import PlacerecError
from service.commands.connection.credentials import add_key
from service.errors.faults import Fault

output = Console()
"""Results."""

messages = Console(stderr=True)
"""Progress, remarks, errors: kept out of what a script reads."""


class Failure(Exception):
    """A command cannot do what it was asked; the text is one plain sentence for the caller."""


class Commands(TyperGroup):
    """A group of commands whose foreseen errors end in a sentence and exit status 1, not in a traceback."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        found = super().get_command(ctx, cmd_name)
        if found is not None:
            add_key(found)
        return found

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (Failure, PlacerecError, Fault) as error:
            complain(str(error))
            raise typer.Exit(1) from error


def complain(sentence: str) -> None:
    """Write an error for a person."""
    messages.print(Text.assemble(("Error: ", "bold red"), sentence), soft_wrap=True)


def remark(sentence: str) -> None:
    """Write something worth knowing."""
    messages.print(Text(sentence), soft_wrap=True)


class Rate(ProgressColumn):
    """How many are done in a second."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f}/s")


def progress() -> Progress:
    """A bar on standard error; on anything but a terminal only its last state is written."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=messages,
    )


def show_json(value: Any) -> None:
    """Write a value as JSON, one line if it is an item of a stream."""
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False))


def table(*columns: str, title: str | None = None) -> Table:
    """An empty table; columns that start with ``#`` hold numbers."""
    made = Table(title=title, title_justify="left", box=None, pad_edge=False, header_style="bold")
    for column in columns:
        made.add_column(column.removeprefix("#"), justify="right" if column.startswith("#") else "left")
    return made


def show(made: Table) -> None:
    """Write a table; off a terminal it is as wide as it needs to be."""
    if output.is_terminal:
        output.print(made)
    else:
        Console(file=output.file, width=10_000).print(made)


def number(value: float | None, digits: int = 3) -> str:
    """A number for a table; a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}"


def write_file(path: Path, text: str) -> None:
    """Write a file whole or not at all.

    Raises:
        Failure: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, text.encode())
    except OSError as error:
        raise Failure(f"{path} cannot be written: {error.strerror}.") from error
