"""The children that read bags while their jobs let others go first."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.app.application import create_app
from service.jobs.context import JobContext
from service.jobs.jobs import Jobs
from service.recordings import readers as children
from service.recordings.readers import Readers
from service.recordings.routes import OCTETS
from service.settings import Settings
from tests.core.recordings.bags import SECOND, START, compressed, walk, write_mcap
from tests.service.jobs.services import end_of
from tests.service.map_jobs import wait_until
from tests.service.recordings.test_reader import order
from tests.service.scenes import jpeg


class Bags:
    """A service's jobs, of which some read bags as the enrolment does."""

    def __init__(self, folder: Path) -> None:
        self.readers, self.read, self.turns = Readers(), list[tuple[str | None, int, int]](), 0
        self.jobs = Jobs.of_directory(folder)
        self.jobs.register("read", self._read, lambda job: self.readers.end(job.id))
        self.jobs.register("other", lambda context: {"attempt": context.attempt})

    def _read(self, context: JobContext) -> dict[str, Any]:
        self.turns += 1
        with self.readers.reading(context, order(Path(context.arguments["bag"]))) as (reader, turns):
            frames = reader.recording().frames
            for number in range(context.notes.get("done", 0), len(frames)):
                turns.begin_step()
                frames[number].load()
                context.remember(done=number + 1)
                turns.end_step()
                self.read.append((context.map_id, number, reader._child.pid))
        return {"frames": len(frames)}


@pytest.fixture
def bags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bags]:
    monkeypatch.setattr("service.jobs.context.SLICE_SECONDS", 0.0)
    made = Bags(tmp_path)
    made.jobs.start()
    yield made
    made.jobs.close()
    made.readers.close()


@contextmanager
def unopened(path: Path) -> Iterator[None]:
    """In the place of a bag there is a pipe, so that whoever opens it waits; at the end it is the bag again."""
    bag, pipe = path.with_suffix(".away"), path.with_suffix(".pipe")
    os.mkfifo(pipe)
    path.rename(bag)
    os.link(pipe, path)
    yield
    bag.replace(path)
    os.close(os.open(pipe, os.O_RDWR))  # whoever has opened it goes on


def test_a_bag_that_is_long_opened_lets_the_jobs_of_other_maps_go_first(bags: Bags, tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "walk.mcap", walk())
    with unopened(bag):
        reading = bags.jobs.submit("read", "x", arguments={"bag": str(bag)})
        for _ in range(3):
            assert end_of(bags.jobs, bags.jobs.submit("other", "y")).state == "succeeded"
        assert not bags.jobs.get(reading.id).ended
    assert end_of(bags.jobs, reading).result == {"frames": 6}
    assert [number for _, number, _ in bags.read] == [*range(6)]
    assert bags.turns > 1 and len({child for _, _, child in bags.read}) == 1, "the child goes on while its job waits"


@pytest.mark.thorough
def test_two_bags_are_read_in_turns(bags: Bags, tmp_path: Path) -> None:
    paths = [write_mcap(tmp_path / f"{name}.mcap", walk()) for name in "xy"]
    with unopened(paths[0]):
        jobs = [bags.jobs.submit("read", path.stem, arguments={"bag": str(path)}) for path in paths]
        wait_until(lambda: bags.jobs.get(jobs[1].id).ended)
        assert not bags.jobs.get(jobs[0].id).ended, "who waits for a bag holds nobody up"
    assert end_of(bags.jobs, jobs[0]).result == {"frames": 6}


@pytest.mark.thorough
def test_where_no_child_may_stay_each_turn_reads_a_frame(
    bags: Bags, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(children, "MOST_WAITING", 0)
    paths = [write_mcap(tmp_path / f"{name}.mcap", walk(3)) for name in "xy"]
    jobs = [bags.jobs.submit("read", path.stem, arguments={"bag": str(path)}) for path in paths]
    assert [end_of(bags.jobs, job).result for job in jobs] == [{"frames": 3}] * 2
    for name in "xy":
        assert [number for map_id, number, _ in bags.read if map_id == name] == [0, 1, 2]
    assert len({child for _, _, child in bags.read}) > 2, "they took turns"


def test_the_child_of_a_job_that_is_cancelled_while_it_waits_ends(bags: Bags, tmp_path: Path) -> None:
    bag, gate = write_mcap(tmp_path / "walk.mcap", walk()), threading.Event()
    bags.jobs.register("gate", lambda _context: {"opened": gate.wait(60)})
    with unopened(bag):
        reading = bags.jobs.submit("read", "x", arguments={"bag": str(bag)})
        other = bags.jobs.submit("gate", "y")
        wait_until(lambda: bool(bags.readers._waiting))
        (child,) = (reader._child for reader in bags.readers._waiting.values())
        assert bags.jobs.cancel(reading.id).state == "cancelled"
        assert child.wait(60) and not bags.readers._waiting
        gate.set()
        assert end_of(bags.jobs, other).state == "succeeded"


@pytest.mark.thorough
def test_bags_that_are_enrolled_in_turns_become_the_same_places(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.jobs.context.SLICE_SECONDS", 0.0)
    said = [compressed(START + number * SECOND, jpeg(number // 3)) for number in range(9)]
    data, gate = write_mcap(tmp_path / "standing.mcap", said).read_bytes(), threading.Event()
    with TestClient(create_app(Settings(data_dir=tmp_path), as_owner=True)) as client:
        client.app.state.jobs.submit("gate", "z", lambda _context: {"opened": gate.wait(60)})  # type: ignore[attr-defined]
        submitted = []
        for name in "xy":
            path = f"/v1/maps/{name}/recordings/standing.mcap"
            assert client.post("/v1/maps", json={"id": name}).status_code == 201
            assert client.put(path, content=data, headers={"Content-Type": OCTETS}).status_code == 200
            submitted.append(client.post(path, json={}).json()["id"])
        gate.set()
        for job in submitted:
            while (ended := client.get(f"/v1/jobs/{job}?wait=20").json())["state"] in ("queued", "running"):
                pass
            assert ended["state"] == "succeeded" and ended["attempt"] > 3, ended
            assert ended["result"]["changes"] == {"created": 3} and ended["result"]["failed"]["count"] == 0
            assert ended["result"]["remarks"] == ["6 of 9 frames show the same as the one before them."]
