"""The command line as a whole: its help, its speed, its errors."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.service.commands.conftest import Placerec
from tests.service.server import ROOT

COMMANDS = ["serve", "enrol", "query", "evaluate", "calibrate", "vocabulary", "model", "maps", "bench", "settings"]


def test_help_names_every_command(placerec: Placerec) -> None:
    shown = placerec("--help").stdout
    assert all(name in shown for name in COMMANDS)


@pytest.mark.parametrize("command", [*COMMANDS, "maps places", "maps sequences", "vocabulary train", "model import"])
def test_each_command_has_help(placerec: Placerec, command: str) -> None:
    assert "--help" in placerec(*command.split(), "--help").stdout


def test_enrol_may_be_spelt_with_two_ls(placerec: Placerec) -> None:
    assert "enroll" not in placerec("--help").stdout
    written, typed = (placerec(name, "--help").stdout.partition("Enrol the frames")[2] for name in ("enrol", "enroll"))
    assert "places of a map" in written and typed == written


@pytest.mark.parametrize("function", ["add_laboratory", "get_command", "open_recording"])
def test_who_interrupts_a_command_while_it_starts_sees_no_traceback(function: str, tmp_path: Path) -> None:
    """While its modules load, while its options are read, and while it works."""
    code = f"""
import os, signal, sys
from service.commands import main

def interrupt(frame, event, argument):
    if frame.f_code.co_name == {function!r}:
        sys.setprofile(None)
        os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.argv = ["placerec", "enrol", {str(tmp_path)!r}, "--map", "lab", "--url", "http://127.0.0.1:9"]
sys.setprofile(interrupt)
main()
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.strip().splitlines()[-1]) == (130, "Interrupted."), done.stderr
    assert "Traceback" not in done.stderr


def test_help_keys_and_settings_load_nothing_heavy() -> None:
    check = (
        "import service.commands, service.settings, service.access.keys, sys;"
        "print([n for n in ('torch', 'faiss', 'cv2', 'fastapi') if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", check], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_group_without_a_command_shows_its_help(placerec: Placerec) -> None:
    assert "create" in placerec("maps", status=2).output
