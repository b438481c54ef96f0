"""The robot's example, as it is written, against a real service."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.service.server import ROOT, Server, free_port

sys.path.insert(0, str(ROOT / "examples"))  # examples are run from their folder

import robot


def run(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100)


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


def test_it_draws_frames_of_its_own(service: Server) -> None:
    done = run("examples/robot.py", "--url", service.client.base_url, "--map", "tour", "--deadline", 20)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 4


def test_it_stops_where_no_frame_will_be_answered(service: Server) -> None:
    done = run("examples/robot.py", "--url", service.client.base_url, "--map", "nowhere")
    assert done.returncode == 1
    assert "The robot stops: " in done.stderr


def test_it_goes_on_without_a_service(pictures: Path) -> None:
    words = ("--url", f"http://127.0.0.1:{free_port()}", "--map", "tour", "--deadline", 0.3)
    done = run("examples/robot.py", *words, "--frames", pictures / "places")
    assert done.returncode == 0, done.stderr
    assert [line.partition(": ")[2][:21] for line in done.stdout.splitlines()] == ["no answer in time: go"] * 3


def localize(answers: list[httpx.Response | Exception], deadline: float) -> tuple[object, list[httpx.Request]]:
    """What ``localize`` makes of these answers, and what it sent."""
    sent: list[httpx.Request] = []

    def handle(request: httpx.Request) -> httpx.Response:
        sent.append(request)
        answer = answers[min(len(sent), len(answers)) - 1]
        if isinstance(answer, Exception):
            raise answer
        return answer

    with httpx.Client(transport=httpx.MockTransport(handle), base_url="http://service") as client:
        return robot.localize(client, "lab", b"frame", "image/jpeg", deadline), sent


def test_a_frame_is_sent_again_under_the_same_id_within_the_deadline() -> None:
    busy = httpx.Response(503, headers={"Retry-After": "0"})
    answers: list[httpx.Response | Exception] = [
        busy,
        httpx.ReadTimeout("late"),
        httpx.Response(200, json={"verdict": "unknown"}),
    ]
    answer, sent = localize(answers, 10)
    assert answer == {"verdict": "unknown"}
    assert len({request.headers["X-Request-Id"] for request in sent}) == 1
    left = [float(request.headers["X-Request-Timeout"]) for request in sent]
    assert left == sorted(left, reverse=True)
    assert left[0] <= 10


def test_the_deadline_is_kept() -> None:
    began = time.monotonic()
    answer, sent = localize([httpx.Response(503, headers={"Retry-After": "30"})], 0.5)
    assert answer is None
    assert len(sent) == 1
    assert time.monotonic() - began < 20, "half a second was given, and thirty asked for"


@pytest.mark.parametrize(
    ("status", "error"), [(422, robot.FrameRefused), (404, robot.QueriesRefused), (500, robot.QueriesRefused)]
)
def test_what_would_be_the_same_again_is_not_sent_again(status: int, error: type[Exception]) -> None:
    content = json.dumps({"detail": "It is so."})
    answer = httpx.Response(status, headers={"Content-Type": "application/problem+json"}, content=content)
    with pytest.raises(error, match=r"It is so\."):
        localize([answer], 10)
