"""A robot in the simulator: it is carried off, is found again by what it sees, and drives on to its goal."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.simulator.run import Run
from tests.clients.ros2.robot import VENV, ros_environment
from tests.service.server import ROOT, Server

PAGE = ROOT / "docs" / "tutorials" / "from-bag-to-robot.md"
PROGRAMS = {
    ".venv-ros/bin/python": VENV / "bin" / "python",
    ".venv/bin/placerec": Path(sys.executable).parent / "placerec",
}
SEED = 1


def commands() -> list[str]:
    """The commands of the page's section, but those that make environments."""
    section = PAGE.read_text().partition("\n## In a simulator\n")[2].partition("\n## ")[0]
    (block,) = re.findall(r"```text\n(.*?)```", section, re.DOTALL)
    whole = block.replace("\\\n", " ").splitlines()
    return [line for line in whole if not line.startswith("(")]


@pytest.fixture(scope="module")
def service(network: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    server = Server(tmp_path_factory.mktemp("simulator"), forked=False).wait()
    yield server
    server.stop()


def do(line: str, folder: Path, url: str) -> str:
    """Run a command of the page, with the address of the service under test."""
    program, *words = shlex.split(line.replace("http://127.0.0.1:8000", url))
    environment = ros_environment(PYTHONPATH=str(ROOT), PATH=os.environ["PATH"])
    done = subprocess.run(
        [PROGRAMS.get(program, program), *words], cwd=folder, env=environment, capture_output=True, text=True
    )
    log = folder / "placerec_node.log"
    said = log.read_text(errors="replace")[-3000:] if log.exists() else ""
    assert done.returncode == 0, f"{line}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}\n{said}"
    return done.stdout


@pytest.mark.soak
@pytest.mark.timeout(1200)
def test_a_robot_that_is_carried_off_drives_on(service: Server, tmp_path: Path) -> None:
    url = f"http://127.0.0.1:{service.port}"
    *before, drive = commands()
    for line in before:
        do(line, tmp_path, url)
    assert "has arrived" in do(f"{drive} --json run.json --seed {SEED}", tmp_path, url)
    run = Run.read(tmp_path / "run.json")
    found = run.figures()
    assert found["silent_frames"] <= 10
    (number,) = [number for number, frame in enumerate(run.frames) if frame.carried]
    assert all(frame.error > 10 for frame in run.frames[number : number + 4]), "it was lost"
    assert 4 <= found["lost_frames"] <= 20 and found["lost_metres"] <= 15
    assert found["error_most"] <= 0.5 and found["within_3"] >= 0.95
    assert found["jump_median"] <= 0.15 and found["jump_most"] <= 0.5
    assert found["jumps_without_evidence"] == 0
    assert found["arrived"] and found["goal_error"] <= 1.0
    assert found["bumps"] == 0
    assert (tmp_path / "drive.svg").read_text().startswith("<svg")
