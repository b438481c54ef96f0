"""The runner of all benchmarks: each part that it names is a program with these arguments."""

from __future__ import annotations

import json
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
    found = find_spec(f"{module}.__main__") if (ROOT / module.replace(".", "/")).is_dir() else find_spec(module)
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


def test_a_part_that_fails_is_named_and_the_others_are_timed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(runner, "RESULTS", tmp_path)
    monkeypatch.setattr(runner, "TIMES", tmp_path / "times.json")
    monkeypatch.setattr(runner, "PARTS", {"missing": Part("benchmarks.nothing"), "platform": Part("platform")})
    with pytest.raises(typer.Exit):
        runner.main([])
    assert "missing" in capsys.readouterr().err
    assert list(json.loads((tmp_path / "times.json").read_text())) == ["platform"]


def test_an_unknown_part_is_refused() -> None:
    with pytest.raises(typer.BadParameter, match="nothing"):
        runner.main(["nothing"])
