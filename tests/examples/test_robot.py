"""The robot's example, as it is written, against a real service."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.server import ROOT, Server, no_service


def run(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    made = run("examples/make_pictures.py", folder)
    assert made.returncode == 0, made.stderr
    assert len(made.stdout.splitlines()) == 7
    return folder


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, pictures: Path) -> Iterator[Server]:
    running = Server(tmp_path_factory.mktemp("robot")).wait()
    running.create_map("tour")
    for path in sorted((pictures / "places").iterdir()):
        assert running.enrol("tour", path.stem, path.read_bytes(), x=1, y=2).status_code == 201
    yield running
    assert running.stop() == 0


def test_the_pictures_are_always_the_same(pictures: Path, tmp_path: Path) -> None:
    run("examples/make_pictures.py", tmp_path)
    for path in pictures.rglob("*.jpg"):
        assert path.stat().st_size < 50_000
        assert path.read_bytes() == (tmp_path / path.relative_to(pictures)).read_bytes()


@pytest.mark.thorough
def test_it_knows_the_places_and_not_the_street(service: Server, pictures: Path) -> None:
    (pictures / "camera" / "5-broken.jpg").write_bytes(b"no frame")
    (pictures / "camera" / "notes.txt").write_text("no frame either")
    words = ("--url", service.client.base_url, "--map", "tour", "--deadline", 20)
    done = run("examples/robot.py", *words, "--frames", pictures / "camera")
    assert done.returncode == 0, done.stderr
    corridor, kitchen, yard, street, broken = done.stdout.splitlines()
    assert corridor.startswith("1-corridor.jpg: at corridor, pose {'x': 1.0, 'y': 2.0}")
    assert kitchen.startswith("2-kitchen.jpg: at kitchen")
    assert yard.startswith("3-yard.jpg: at yard")
    assert street.startswith("4-street.jpg: not a place of this map")
    assert broken.startswith("5-broken.jpg: frame refused: ")


@pytest.mark.thorough
def test_it_draws_frames_of_its_own(service: Server) -> None:
    done = run("examples/robot.py", "--url", service.client.base_url, "--map", "tour", "--deadline", 20)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 4


@pytest.mark.thorough
def test_it_stops_where_no_frame_will_be_answered(service: Server) -> None:
    done = run("examples/robot.py", "--url", service.client.base_url, "--map", "nowhere")
    assert done.returncode == 1
    assert "The robot stops: " in done.stderr


@pytest.mark.thorough
def test_it_goes_on_without_a_service(pictures: Path) -> None:
    with no_service() as gone:
        words = ("--url", gone, "--map", "tour", "--deadline", 0.3)
        done = run("examples/robot.py", *words, "--frames", pictures / "places")
    assert done.returncode == 0, done.stderr
    assert [line.partition(": ")[2][:21] for line in done.stdout.splitlines()] == ["no answer in time: go"] * 3
