from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from service.commands.options.objects import takes


@dataclass(frozen=True)
class Light:
    lamps: Annotated[int, typer.Option(min=1, help="How many lamps.")] = 1
    dimmed: Annotated[bool, typer.Option("--dim", rich_help_panel="Brightness")] = False


@dataclass(frozen=True)
class Room:
    name: Annotated[str, typer.Argument()]
    light: Light
    plans: Annotated[list[Path] | None, typer.Option("--plan")] = None


seen: list[Room] = []
application = typer.Typer()


@application.command()
@takes(Room)
def furnish(room: Room) -> None:
    """Furnish a room."""
    seen.append(room)


def run(*words: str) -> tuple[int, str]:
    found = CliRunner().invoke(application, words)
    return found.exit_code, found.output


def test_fields_are_parameters() -> None:
    seen.clear()
    assert run("kitchen")[0] == 0
    assert run("hall", "--lamps", "3", "--dim", "--plan", "a", "--plan", "b")[0] == 0
    assert seen == [Room("kitchen", Light()), Room("hall", Light(3, True), [Path("a"), Path("b")])]


def test_typer_checks_them() -> None:
    assert run()[0] == 2
    code, text = run("hall", "--lamps", "0")
    assert code == 2 and "lamps" in text


def test_help_has_the_fields_in_their_order() -> None:
    command = typer.main.get_command(application)
    assert command.help == "Furnish a room."
    assert [parameter.name for parameter in command.params[:4]] == ["name", "lamps", "dimmed", "plans"]
    assert "How many lamps." in run("--help")[1]


def test_names_are_unique() -> None:
    @dataclass(frozen=True)
    class Twice:
        light: Light
        lamps: int = 2

    with pytest.raises(ValueError, match="duplicate parameter name: 'lamps'"):
        takes(Twice)
