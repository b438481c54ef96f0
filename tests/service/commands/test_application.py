"""The command line as a whole: its help, its speed, its errors."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import packages_distributions, requires

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from service.commands.console import EXTRAS
from tests.service.commands.conftest import Placerec
from tests.service.server import ROOT

COMMANDS = ["serve", "enroll", "query", "evaluate", "calibrate", "vocabulary", "model", "maps", "bench", "settings"]


def test_help_names_every_command(placerec: Placerec) -> None:
    shown = placerec("--help").stdout
    assert all(name in shown for name in COMMANDS)


@pytest.mark.parametrize("command", [*COMMANDS, "maps places", "maps sequences", "vocabulary train", "model import"])
def test_each_command_has_help(placerec: Placerec, command: str) -> None:
    assert "--help" in placerec(*command.split(), "--help").stdout


def test_help_loads_nothing_heavy() -> None:
    check = "import service.commands, sys; print([n for n in ('torch', 'faiss', 'cv2', 'fastapi') if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", check], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_group_without_a_command_shows_its_help(placerec: Placerec) -> None:
    assert "create" in placerec("maps", status=2).output


def test_each_extra_is_checked_by_what_it_brings() -> None:
    wanted: dict[str, set[str]] = {}
    for requirement in map(Requirement, requires("placerec") or []):
        extra = re.search(r"extra == .(\w+)", str(requirement.marker))
        if extra and extra[1] != "dev":
            wanted.setdefault(extra[1], set()).add(canonicalize_name(requirement.name))
    brought = packages_distributions()
    assert {
        extra: {canonicalize_name(name) for module in modules for name in brought[module]}
        for extra, modules in EXTRAS.items()
    } == wanted
