"""The laboratory's commands, where it is installed and where it is not."""

from __future__ import annotations

import pytest
import typer
from typer.testing import CliRunner

from service.commands import laboratory
from service.commands.console import Commands
from service.commands.laboratory import COMMANDS, add_laboratory


def command_line() -> typer.Typer:
    application = typer.Typer(cls=Commands)
    application.command("serve")(lambda: None)
    add_laboratory(application)
    return application


def test_they_are_listed_where_it_is() -> None:
    listed = CliRunner().invoke(command_line(), ["--help"]).stdout
    assert all(name in listed for name in COMMANDS)


@pytest.mark.parametrize("missing", ["lab", "matplotlib"])
@pytest.mark.parametrize(
    "words", [["evaluate", "--reference", "monday"], ["model", "import", "x.onnx"], ["vocabulary"]]
)
def test_they_say_how_to_get_it_where_it_is_not(
    words: list[str], missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(laboratory, "find_spec", lambda name: None if name == missing else name)
    application = command_line()
    assert not any(name in CliRunner().invoke(application, ["--help"]).stdout for name in COMMANDS)
    refused = CliRunner().invoke(application, words)
    assert refused.exit_code == 1 and f"`placerec {words[0]}` belongs to the laboratory" in refused.stderr
    assert "pip install 'placerec[lab]'" in refused.stderr.replace("\n", " ")
