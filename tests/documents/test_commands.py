"""The commands of the documents: each is one that there is, and those that everybody begins with run as written."""

from __future__ import annotations

import itertools
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import typer.main

from service.commands.application import application
from tests.service.server import ROOT, Server

BLOCK = re.compile(r"^```sh\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PYTHON = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
SHOWN = re.compile(r"\bplacerec (.*)")
WRITTEN_ADDRESS = "http://127.0.0.1:8000"
"""The address in the documents; the service under test listens on another port."""

# A refusal by the service is an error of the document; curl alone would not see it as one.
PRELUDE = 'curl() { command curl --fail-with-body --show-error "$@"; }\n'


def commands(document: Path) -> str:
    """All commands of a document; of the README those of the section that is run beside a service."""
    text = document.read_text()
    if document == README:
        text = text.partition("\n## Five minutes")[2].partition("\n## ")[0]
    return "\n".join(BLOCK.findall(text))


README = ROOT / "README.md"
FIRST_MAP = ROOT / "docs" / "tutorials" / "first-map.md"
OF_THE_CLIENT = ROOT / "docs" / "how-to" / "use-the-python-client.md"
PAGES = [page for page in (README, *sorted((ROOT / "docs").rglob("*.md"))) if commands(page)]


def test_what_the_commands_name_is_there() -> None:
    """Every ``placerec`` of a page is a command with these options."""
    assert len(PAGES) > 20
    lines = [line for page in PAGES for line in SHOWN.findall(commands(page).replace("\\\n", " "))]
    program = typer.main.get_command(application)
    assert [line for line in lines if not is_a_command(line, program)] == []


def is_a_command(line: str, command: Any) -> bool:
    """Whether the words after ``placerec`` are a command's, and its options."""
    for word in itertools.takewhile(lambda word: not word.startswith(("|", ">", "&", ";", "#")), line.split()):
        if word.startswith("--"):
            options = [option for parameter in command.params for option in parameter.opts + parameter.secondary_opts]
            if word.partition("=")[0] not in [*options, "--help"]:
                return False
        elif commands_below := getattr(command, "commands", None):
            if word not in commands_below:
                return False
            command = commands_below[word]
    return True


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that ``examples/make_pictures.py`` makes, which every page begins with."""
    folder = tmp_path_factory.mktemp("made")
    run([sys.executable, ROOT / "examples/make_pictures.py", "pictures"], folder, dict(os.environ))
    return folder / "pictures"


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The service of all pages."""
    service = Server(tmp_path_factory.mktemp("shared")).wait()
    yield service
    assert service.stop() == 0


@pytest.mark.thorough
def test_the_python_of_the_readme_runs_as_it_is_written(tmp_path: Path, pictures: Path) -> None:
    shutil.copytree(pictures, tmp_path / "pictures")
    (program,) = PYTHON.findall(README.read_text())
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    assert run([sys.executable, "-c", program], tmp_path, environment).startswith("recognized corridor ")


@pytest.mark.thorough
def test_the_python_of_the_client_runs_as_it_is_written(shared: Server, tmp_path: Path, pictures: Path) -> None:
    shutil.copytree(pictures, tmp_path / "pictures")
    programs = PYTHON.findall(OF_THE_CLIENT.read_text())
    assert len(programs) > 6
    for program in programs:
        run([sys.executable, "-c", f"url = '{shared.client.base_url}'\n{program}"], tmp_path, dict(os.environ))
    forget_maps(shared)


@pytest.mark.thorough
@pytest.mark.parametrize("document", [README, FIRST_MAP], ids=lambda page: page.stem)
def test_the_commands_run_as_they_are_written(document: Path, shared: Server, tmp_path: Path, pictures: Path) -> None:
    """In a folder with the examples, their pictures and a ``.venv``."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    (tmp_path / ".venv").symlink_to(sys.prefix)
    shutil.copytree(pictures, tmp_path / "pictures")
    root = str(shared.client.base_url).rstrip("/")
    environment = {
        **os.environ,
        "url": root,
        "api": f"{root}/v1",
        "PATH": os.pathsep.join([str(Path(sys.prefix) / "bin"), os.environ["PATH"]]),
        "PLACEREC_DATA_DIR": str(shared.data_dir),  # for what is done beside a running service
    }
    script = PRELUDE + commands(document).replace(WRITTEN_ADDRESS, root)
    run(["bash", "-euxo", "pipefail", "-c", script], tmp_path, environment)
    forget_maps(shared)


def forget_maps(service: Server) -> None:
    """So that the next page can make those of the same names."""
    for item in service.client.get("/v1/maps").json()["items"]:
        service.client.delete(f"/v1/maps/{item['id']}")


def run(command: Sequence[str | Path], folder: Path, environment: Mapping[str, str]) -> str:
    """What a command that has to succeed writes to standard output."""
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, f"{done.stderr[-3000:]}\n{done.stdout[-3000:]}"
    return done.stdout
