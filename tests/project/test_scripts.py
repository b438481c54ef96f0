"""The scripts: they can be run, and .venv is made once, by one of them, from the lock files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# Replaces Python: a venv is a copy of this script, what pip installs a line in a log; the rest is real.
STUB = """#!/bin/bash
case "$1 $2" in
    "-m venv") mkdir -p "${@: -1}/bin" && cp "$0" "${@: -1}/bin/python" && echo venv >>"$LOG" ;;
    "-m pip") sleep 0.1 && echo "${*: -1}" >>"$LOG" && [ ! -e "$LOG.full" ] ;;
    "scripts/packages.py "*) echo "$2 ${TORCH_BACKEND:-}" >>"$LOG" && [ ! -e "$LOG.full" ] ;;
    "-c import service.app.application"*) ;;
    *) exec REAL "$@" ;;
esac
"""


class Checkout:
    """A folder with the real scripts/environment and an interpreter that only logs what it should install."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.log = folder, folder / "log"
        for name in ("scripts", "requirements"):
            (folder / name).mkdir()
        (folder / "scripts/environment").write_text((ROOT / "scripts/environment").read_text())
        (folder / "pyproject.toml").write_text("[project]\n")
        for name in ("torch", "service", "lab", "development"):
            (folder / f"requirements/{name}.lock").write_text(f"{name}\n")
        self.python = folder / "python"
        self.python.write_text(STUB.replace("REAL", sys.executable))
        self.python.chmod(0o755)

    def start(self, profile: str, python: str | None = None, backend: str = "") -> subprocess.Popen[str]:
        return subprocess.Popen(
            ["bash", "-c", f"set -eu; . '{self.folder}/scripts/environment'; environment {profile}; echo ready"],
            env={**os.environ, "PYTHON": python or str(self.python), "LOG": str(self.log), "TORCH_BACKEND": backend},
            cwd="/",
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def prepare(self, profile: str, backend: str = "") -> list[str]:
        """Run ``environment PROFILE``; what it installed, in order."""
        self.log.write_text("")
        out, error = self.start(profile, backend=backend).communicate(timeout=300)
        assert out == "ready\n", error
        return self.log.read_text().split()


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def test_nothing_is_installed_twice(checkout: Checkout) -> None:
    assert checkout.prepare("service") == ["venv", "service", "cpu", "."]
    assert checkout.prepare("service") == []


def test_development_serves_too(checkout: Checkout) -> None:
    assert checkout.prepare("development") == ["venv", "development", "cpu", "."]
    assert checkout.prepare("service") == checkout.prepare("lab") == []


def test_the_laboratory_serves_and_a_service_has_none(checkout: Checkout) -> None:
    assert checkout.prepare("service") == ["venv", "service", "cpu", "."]
    assert checkout.prepare("lab") == ["lab", "cpu", "."]
    assert checkout.prepare("service") == []


def test_a_changed_lock_installs_again_into_the_same_venv(checkout: Checkout) -> None:
    checkout.prepare("service")
    (checkout.folder / "requirements/service.lock").write_text("newer\n")
    assert checkout.prepare("service") == ["service", "cpu", "."]


def test_another_build_of_torch_gets_a_new_venv(checkout: Checkout) -> None:
    checkout.prepare("service")
    assert checkout.prepare("service", backend="auto") == ["venv", "service", "auto", "."]
    assert checkout.prepare("service") == [], "the choice stays"
    assert checkout.prepare("service", backend="cpu") == ["venv", "service", "cpu", "."]


def test_a_venv_of_an_earlier_version_is_made_anew(checkout: Checkout) -> None:
    checkout.prepare("service")
    (checkout.folder / ".venv/torch-backend").unlink()
    (checkout.folder / ".venv/installed-service").write_text("earlier\n")
    assert checkout.prepare("service") == ["venv", "service", "cpu", "."]


def test_two_runs_at_once_install_once(checkout: Checkout) -> None:
    runs = [checkout.start("development") for _ in range(3)]
    assert [run.communicate(timeout=300)[0] for run in runs] == ["ready\n"] * 3
    assert checkout.log.read_text().split() == ["venv", "development", "cpu", "."]


@pytest.mark.thorough
def test_an_interrupted_installation_is_repeated(checkout: Checkout) -> None:
    checkout.prepare("service")
    (checkout.folder / "requirements/service.lock").write_text("newer\n")
    full = Path(f"{checkout.log}.full")
    full.touch()
    run = checkout.start("service")
    assert run.communicate(timeout=300)[0] == "" and run.returncode != 0
    full.unlink()
    assert checkout.prepare("service")


def test_an_old_python_is_refused_with_a_message(checkout: Checkout) -> None:
    run = checkout.start("service", python="/bin/false")
    out, error = run.communicate(timeout=300)
    assert (out, run.returncode) == ("", 1)
    assert "Python 3.11 or later" in error
