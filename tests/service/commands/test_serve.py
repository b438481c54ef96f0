"""``placerec serve``: how it starts, refuses and stops; as a process, like an operator's."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.service.server import ROOT, Server


def refused(*words: object, **settings: object) -> str:
    """What it says when it does not start."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PLACEREC_")}
    environment |= {f"PLACEREC_{name.upper()}": str(value) for name, value in settings.items()}
    command = [sys.executable, "-m", "service.commands", "serve", *map(str, words)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr


@pytest.mark.thorough
def test_it_does_not_start_on_a_port_in_use(server: Server, tmp_path: Path) -> None:
    said = refused("--port", server.port, "--data-dir", tmp_path)
    assert f"Error: Cannot listen on port {server.port} of 127.0.0.1" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.thorough
def test_it_is_not_exposed_without_keys(tmp_path: Path) -> None:
    said = refused("--host", "0.0.0.0", "--port", 0, data_dir=tmp_path / "data")
    assert "PLACEREC_HOST" in said and "PLACEREC_ALLOW_ANONYMOUS" in said
    assert not (tmp_path / "data").exists()


def test_a_wrong_setting_is_named(tmp_path: Path) -> None:
    assert "PLACEREC_QUEUE_LENGTH: " in refused(queue_length="no number", data_dir=tmp_path / "data")
    assert not (tmp_path / "data").exists()


@pytest.mark.thorough
def test_it_stops_on_a_signal_and_gives_the_data_back(tmp_path: Path) -> None:
    first = Server(tmp_path)
    first.wait("/livez")
    assert first.stop() == 0
    second = Server(tmp_path)
    second.wait("/livez")
    assert second.stop() == 0
