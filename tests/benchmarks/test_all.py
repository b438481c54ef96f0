"""The runner of all benchmarks: each part that it names is a program with these arguments."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import typer

from benchmarks import all as runner
from benchmarks.all import PARTS, ROOT, Part

PAGE = (ROOT / "docs" / "benchmarks.md").read_text()


@pytest.mark.parametrize("name", PARTS)
def test_a_part_is_a_runnable_module(name: str) -> None:
    module = PARTS[name].module
    found = find_spec(module)
    if found is not None and found.submodule_search_locations:
        found = find_spec(f"{module}.__main__")
    assert found is not None and found.origin is not None
    source = Path(found.origin)
    assert source.name == "__main__.py" or 'if __name__ == "__main__":' in source.read_text()


@pytest.mark.thorough
@pytest.mark.parametrize("name", PARTS)
def test_a_part_knows_its_options(name: str) -> None:
    words = [sys.executable, *PARTS[name].command(Path("datasets")), "--help"]
    shown = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True, env={"COLUMNS": "200"}).stdout
    assert [word for word in words if word.startswith("--") and word not in shown] == []


@pytest.mark.parametrize("name", PARTS)
def test_the_page_names_every_part(name: str) -> None:
    assert f"`{name}`" in PAGE


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(runner, "RESULTS", tmp_path)
    monkeypatch.setattr(runner, "MEASURED", tmp_path / "all.json")
    return tmp_path / "all.json"


def parts(monkeypatch: pytest.MonkeyPatch, **modules: str) -> None:
    monkeypatch.setattr(runner, "PARTS", {name: Part(module) for name, module in modules.items()})


def test_a_part_that_fails_is_named_and_the_others_are_noted(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parts(monkeypatch, missing="benchmarks.nothing", platform="platform")
    with pytest.raises(typer.Exit):
        runner.main([])
    assert "missing" in capsys.readouterr().err
    found = json.loads(results.read_text())
    assert list(found) == ["platform"] and found["platform"]["command"] == "python -m platform"
    assert found["platform"]["output"] == [platform.platform()] and found["platform"]["commit"] == runner.state()


def test_a_run_is_resumed_where_it_was_and_begins_anew_with_another_commit(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run() -> list[str]:
        runner.main([], resume=True)
        return re.findall(r"^(\w+): python", capsys.readouterr().out, re.MULTILINE)

    parts(monkeypatch, one="platform")
    assert run() == ["one"]
    parts(monkeypatch, one="platform", two="platform")
    assert run() == ["two"] and run() == []
    monkeypatch.setattr(runner, "state", lambda: "another")
    assert run() == ["one", "two"]
    assert {found["commit"] for found in json.loads(results.read_text()).values()} == {"another"}


def test_the_figures_that_a_part_wrote_are_kept(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = results.parent / "part.py"
    (results.parent / "earlier.json").write_text("{}")
    os.utime(results.parent / "earlier.json", (0, 0))
    program.write_text(
        f"from pathlib import Path; Path({str(results.parent)!r}, 'own.json').write_text('{{\"ms\": 7}}')"
    )
    monkeypatch.setattr(Part, "command", lambda self, data: [str(program)])
    parts(monkeypatch, own="")
    runner.main([])
    assert json.loads(results.read_text())["own"]["figures"] == {"own": {"ms": 7}}


def test_an_unknown_part_is_refused() -> None:
    with pytest.raises(typer.BadParameter, match="nothing"):
        runner.main(["nothing"])
