"""Commands run in this process, as the entry point runs them, on a data directory of the test's own."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import pytest
import typer.main
from typer.testing import CliRunner, Result

from service.commands.application import application
from tests.service.scenes import encoded, scene

COMMAND = typer.main.get_command(application)
"""Made once; typer's runner would make it for every run, which takes longer than most of them."""


class Placerec(Protocol):
    """Runs ``placerec`` with these words and checks its exit status."""

    def __call__(self, *words: object, status: int = 0, stdin: str | None = None) -> Result: ...


@pytest.fixture
def placerec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Placerec]:
    for name in [name for name in os.environ if name.startswith("PLACEREC_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PLACEREC_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("typer.testing._get_command", lambda _: COMMAND)
    runner = CliRunner()

    def run(*words: object, status: int = 0, stdin: str | None = None) -> Result:
        result = runner.invoke(application, [str(word) for word in words], input=stdin, catch_exceptions=False)
        assert result.exit_code == status, f"{words}: {result.exit_code}\n{result.stdout}\n{result.stderr}"
        return result

    log = logging.getLogger("placerec")
    before = log.handlers[:], log.propagate, log.level
    yield run
    log.handlers[:], log.propagate = before[0], before[1]  # the service in this process has set its own
    log.setLevel(before[2])


@pytest.fixture
def monday(tmp_path: Path) -> Path:
    """A traverse of four places: 1.jpg, 2.jpg, 9.jpg, 10.jpg show the scenes 0 to 3."""
    folder = tmp_path / "monday"
    folder.mkdir()
    for index, name in enumerate(("1", "2", "9", "10")):
        (folder / f"{name}.jpg").write_bytes(encoded(scene(index)))
    return folder
