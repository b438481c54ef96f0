"""The commands of the documents, as they are written, against a real service."""

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
from tests.service.command_forks import ForkedCommands
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
    if document == ROOT / "README.md":
        text = text.partition("\n## Five minutes")[2].partition("\n## ")[0]
    return "\n".join(BLOCK.findall(text))


PAGES = [page for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))) if commands(page)]
OF_KEYS = ROOT / "docs" / "how-to" / "keys-and-tls.md"
"""After its commands every request needs a key."""


LONG = (
    "docs/how-to/align-traverses",
    "docs/how-to/bring-your-own-network",
    "docs/how-to/calibrate-a-map",
    "docs/how-to/enrol-bags-and-videos",
    "docs/how-to/evaluate",
    "docs/how-to/erase-frames",
    "docs/how-to/look-after-maps",
    "docs/how-to/tune-for-a-machine",
    "docs/tutorials/from-bag-to-robot",
    "docs/tutorials/session",
    "docs/tutorials/traverse",
)
"""Pages that take from five to eighteen seconds of a processor, most of it to encode frames."""


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).with_suffix("").as_posix()


CASES = [
    pytest.param(page, id=name_of(page), marks=pytest.mark.thorough if name_of(page) in LONG else ())
    for page in PAGES
    if page != OF_KEYS
]


def test_long_pages_are_pages() -> None:
    assert set(LONG) < {name_of(page) for page in PAGES}


@pytest.mark.thorough
@pytest.mark.parametrize("document", PAGES, ids=name_of)
def test_what_the_commands_name_is_there(document: Path) -> None:
    """Every ``placerec`` of a page is a command with these options, also where the page itself is not run."""
    for line in SHOWN.findall(commands(document).replace("\\\n", " ")):
        command: Any = typer.main.get_command(application)
        for word in itertools.takewhile(lambda word: not word.startswith(("|", ">", "&", ";", "#")), line.split()):
            if word.startswith("--"):
                options = [
                    option for parameter in command.params for option in parameter.opts + parameter.secondary_opts
                ]
                assert word.partition("=")[0] in [*options, "--help"], line
            elif commands_below := getattr(command, "commands", None):
                assert word in commands_below, line
                command = commands_below[word]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that ``examples/make_pictures.py`` makes, which every page begins with."""
    folder = tmp_path_factory.mktemp("made")
    run([sys.executable, ROOT / "examples/make_pictures.py", "pictures"], folder, dict(os.environ))
    return folder / "pictures"


@pytest.mark.thorough
def test_the_python_of_the_readme_runs_as_it_is_written(tmp_path: Path, pictures: Path) -> None:
    shutil.copytree(pictures, tmp_path / "pictures")
    (program,) = PYTHON.findall((ROOT / "README.md").read_text())
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    assert run([sys.executable, "-c", program], tmp_path, environment).startswith("recognized corridor ")


OF_THE_CLIENT = ROOT / "docs" / "how-to" / "use-the-python-client.md"


@pytest.mark.thorough
def test_the_python_of_the_client_runs_as_it_is_written(shared: Server, tmp_path: Path, pictures: Path) -> None:
    shutil.copytree(pictures, tmp_path / "pictures")
    programs = PYTHON.findall(OF_THE_CLIENT.read_text())
    assert len(programs) > 6
    for program in programs:
        run([sys.executable, "-c", f"url = '{shared.client.base_url}'\n{program}"], tmp_path, dict(os.environ))
    for item in shared.client.get("/v1/maps").json()["items"]:
        shared.client.delete(f"/v1/maps/{item['id']}")


def run(command: Sequence[str | Path], folder: Path, environment: Mapping[str, str]) -> str:
    """What a command that has to succeed writes to standard output."""
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, f"{done.stderr[-3000:]}\n{done.stdout[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The service of all pages but that which creates keys."""
    service = Server(tmp_path_factory.mktemp("shared")).wait()
    yield service
    assert service.stop() == 0


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A ``.venv`` that is this one but for ``placerec``, which is forked off."""
    folder = tmp_path_factory.mktemp("environment")
    installed = Path(sys.prefix)
    for path in installed.iterdir():
        if path.name != "bin":
            (folder / path.name).symlink_to(path)
    (folder / "bin").mkdir()
    for path in (installed / "bin").iterdir():
        if path.name != "placerec":
            (folder / "bin" / path.name).symlink_to(path)
    forked = ForkedCommands(folder / "bin")
    yield folder
    forked.close()


@pytest.mark.thorough
@pytest.mark.parametrize("document", CASES)
def test_the_commands_run_as_they_are_written(
    document: Path, shared: Server, tmp_path: Path, pictures: Path, environment: Path
) -> None:
    try:
        run_page(document, shared, tmp_path, pictures, environment)
    finally:
        for item in shared.client.get("/v1/maps").json()["items"]:
            shared.client.delete(f"/v1/maps/{item['id']}")


@pytest.mark.thorough
def test_the_page_on_keys_runs_as_it_is_written(tmp_path: Path, pictures: Path) -> None:
    """With the ``placerec`` that is installed."""
    service = Server(tmp_path / "service").wait()
    try:
        run_page(OF_KEYS, service, tmp_path, pictures, Path(sys.prefix))
    finally:
        status = service.stop()
    assert status == 0


def run_page(document: Path, service: Server, folder: Path, pictures: Path, installed: Path) -> None:
    """Run all commands of a document in a folder with the examples, their pictures and a ``.venv``."""
    here = folder / "here"
    here.mkdir()
    shutil.copytree(ROOT / "examples", here / "examples")
    (here / ".venv").symlink_to(installed)
    shutil.copytree(pictures, here / "pictures")
    root = str(service.client.base_url).rstrip("/")
    environment = {
        **os.environ,
        "url": root,
        "api": f"{root}/v1",
        "PATH": os.pathsep.join([str(installed / "bin"), os.environ["PATH"]]),
        "XDG_CACHE_HOME": str(folder / "cache"),
        "PLACEREC_DATA_DIR": str(service.data_dir),  # for what is done beside a running service
    }
    script = PRELUDE + commands(document).replace(WRITTEN_ADDRESS, root)
    run(["bash", "-euxo", "pipefail", "-c", script], here, environment)
