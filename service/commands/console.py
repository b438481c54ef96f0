"""The output of all commands: output, errors, progress bars, tables."""

from __future__ import annotations

import json
import re
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
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from core.disk.files import write_file as write_durably
from core.errors import PlacerecError
from core.names import UNSEEN
from service.commands.connection.credentials import add_key
from service.errors.faults import Fault

output = Console()
"""Standard output: results."""

messages = Console(stderr=True)
"""Standard error: progress, remarks, errors."""


RENAMED = {("places", "forget"): "delete", ("sequences", "forget"): "delete", ("keys", "revoke"): "delete"}
"""Commands by their group and the names that they had once."""


UNPRINTABLE = re.compile(rf"(?![\t\n])[{UNSEEN}\ud800-\udfff\U000e0000-\U000e007f]")
"""Characters that no name may have, but for a tab and the end of a line: with them a text could drive the terminal,
turn a line around, or hide something.  Surrogates, which no terminal takes, and invisible tags are among them."""


class Failure(Exception):
    """A command failed for a foreseen reason; its text explains it to the user."""


class Commands(TyperGroup):
    """A group of commands that ends foreseen errors with a message and exit status 1, without a traceback.

    An interrupted one ends with a message, which may be that of the ``KeyboardInterrupt``, and exit status 130.

    A command is also refused, with exit status 2, by a name that it had once; the message has its present one.
    """

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        found = super().get_command(ctx, cmd_name)
        if found is not None:
            add_key(found)
        elif (new := RENAMED.get((ctx.info_name, cmd_name))) is not None:
            ctx.fail(f"`{ctx.command_path} {cmd_name}` is `{ctx.command_path} {new}` now: use {new}.")
        return found

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (Failure, PlacerecError, Fault) as error:
            complain(str(error))
            raise typer.Exit(1) from error
        except KeyboardInterrupt as error:
            remark(str(error) or "Interrupted.")
            raise typer.Exit(130) from error


def printable(text: str) -> str:
    """A text with its unprintable characters as JSON writes them (``\\u001b``), for it may come from anybody."""
    return UNPRINTABLE.sub(_escaped, text)


def _escaped(found: re.Match[str]) -> str:
    units = found[0].encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at : at + 2].hex()}" for at in range(0, len(units), 2))


def say(sentence: str) -> None:
    """Write a sentence to standard output."""
    output.print(Text(printable(sentence)), soft_wrap=True)


def complain(sentence: str) -> None:
    """Write an error to standard error."""
    messages.print(Text.assemble(("Error: ", "bold red"), printable(sentence)), soft_wrap=True)


def remark(sentence: str) -> None:
    """Write a remark to standard error."""
    messages.print(Text(printable(sentence)), soft_wrap=True)


class Rate(ProgressColumn):
    """The column of a progress bar that shows the items a second."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f}/s")


class Title(ProgressColumn):
    """The column of a progress bar that shows what is done, which may contain the name of a map or of a file."""

    def render(self, task: Task) -> Text:
        return Text(printable(task.description))


def progress() -> Progress:
    """A progress bar on standard error; if that is no terminal, only the last state is written."""
    return Progress(
        Title(),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=messages,
    )


def show_json(value: Any) -> None:
    """Write a value as indented JSON to standard output."""
    typer.echo(json_text(value, indent=2))


def json_text(value: Any, indent: int | None = None) -> str:
    """JSON for a terminal: only characters that would drive it are escaped."""
    return printable(json.dumps(value, indent=indent, ensure_ascii=False))


class PlainTable(Table):
    """A table of texts that are shown as they are, whoever wrote them: none is markup, none drives the terminal."""

    def add_row(self, *cells: Any, **options: Any) -> None:
        super().add_row(*(Text(printable(one)) if isinstance(one, str) else one for one in cells), **options)


def table(*columns: str, title: str | None = None) -> Table:
    """An empty table; a column whose name starts with ``#`` is aligned right, for numbers."""
    made = PlainTable(
        title=None if title is None else Text(printable(title), style="table.title"),
        title_justify="left",
        box=None,
        pad_edge=False,
        header_style="bold",
    )
    for column in columns:
        heading = Text(printable(column.removeprefix("#")))
        made.add_column(heading, justify="right" if column.startswith("#") else "left")
    return made


def show(made: Table) -> None:
    """Write a table; if the output is no terminal, it is as wide as its contents."""
    if output.is_terminal:
        output.print(made)
    else:
        Console(file=output.file, width=10_000).print(made)


def words(value: Any) -> str:
    """A value of JSON in one cell of a table, without its brackets and quotes."""
    if value is None or value in ({}, [], ""):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict) and value.keys() == {"value", "low", "high", "count", "of"}:  # a share
        share = f"{value['count']} of {value['of']}"
        return f"{value['value']:.3f} ({value['low']:.3f} to {value['high']:.3f}; {share})" if value["of"] else share
    if isinstance(value, dict):
        return "; ".join(f"{name}: {words(one)}" for name, one in value.items())
    return ", ".join(map(words, value)) if isinstance(value, list) else str(value)


def number(value: float | None, digits: int = 3) -> str:
    """A number for a table; a dash for None."""
    return "–" if value is None else f"{value:.{digits}f}"


def write_file(path: Path, text: str) -> None:
    """Write a file whole or not at all; the process's umask says for whom it is.

    Raises:
        Failure: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, text.encode(), private=False)
    except OSError as error:
        raise Failure(f"{path} cannot be written: {error.strerror}.") from error
