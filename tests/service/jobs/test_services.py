"""Jobs over several services, of which some are killed."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from service.errors.faults import JobQueueFull
from service.jobs.context import JobContext
from service.peers import replica as replicas
from service.shared.database import SharedDatabase
from tests.service.jobs.services import Gate, Service, end_of
from tests.service.jobs.worker import walk
from tests.service.server import ROOT

pytestmark = pytest.mark.postgres


@pytest.fixture
def quick(database: SharedDatabase, monkeypatch: pytest.MonkeyPatch) -> str:
    """Services that count as gone after two seconds, so that no test has to wait for ten; the database's address."""
    monkeypatch.setattr(replicas, "BEAT_SECONDS", 0.2)
    monkeypatch.setattr(replicas, "LOSING_SECONDS", 1.2)
    monkeypatch.setattr(replicas, "GONE_SECONDS", 2.0)
    return database.address


def test_jobs_of_two_services(quick: str, tmp_path: Path) -> None:
    ran: list[tuple[str, str]] = []
    gates = {name: Gate() for name in ("lab", "hall")}
    both = threading.Lock()

    def work_of(service: str) -> Callable[[JobContext], Mapping[str, Any]]:
        def work(context: JobContext) -> Mapping[str, Any]:
            with both:
                ran.append((service, str(context.map_id)))
            return gates[str(context.map_id)](context)

        return work

    with ExitStack() as stack:
        services = []
        for name in ("one", "other"):
            service = Service(quick, tmp_path / name, {"gate": work_of(name)}, longest_queue=3).start()
            stack.callback(service.close)
            services.append(service.jobs)
        one, other = services
        lab, again, hall = (
            one.submit("gate", name, arguments={"n": n}) for n, name in enumerate(("lab", "lab", "hall"))
        )
        assert gates["lab"].begun.wait(10) and gates["hall"].begun.wait(10)
        assert {service for service, _ in ran} == {"one", "other"}, "each does one"
        for jobs in services:  # what one does, the other shows; of each map one job runs at a time
            assert [jobs.get(job.id).state for job in (lab, again, hall)] == ["running", "queued", "running"]
            assert [job.id for job in jobs.all()] == [lab.id, again.id, hall.id]
        waiting = [services[n % 2].submit("gate", "lab", arguments={}) for n in range(2)]
        with pytest.raises(JobQueueFull):
            other.submit("gate", "yard", arguments={})
        # Cancelled at the service that does not do it; followed there, too.
        at = {map_id: service for service, map_id in ran}
        far = {"one": other, "other": one}[at["hall"]]
        assert far.cancel(hall.id).cancelling
        assert end_of(far, hall).state == "cancelled"
        for job in waiting:
            assert one.cancel(job.id).state == other.get(job.id).state == "cancelled"
        gates["lab"].open.set()
        assert [end_of(jobs, job).state for jobs, job in ((one, lab), (other, again))] == ["succeeded"] * 2


@pytest.mark.thorough
def test_a_job_is_taken_over_from_its_checkpoint(quick: str, tmp_path: Path) -> None:
    held, seen = threading.Event(), list[tuple[str, int, object]]()

    def work_of(service: str) -> Callable[[JobContext], Mapping[str, Any]]:
        def work(context: JobContext) -> Mapping[str, Any]:
            seen.append((service, context.attempt, context.notes.get("step")))
            context.remember(step=context.attempt)
            if context.attempt == 1:
                held.wait(60)  # deaf for a while, as a process that was stopped
                context.remember(step="too late")
            return {"by": service}

        return work

    one = Service(quick, tmp_path / "one", {"walk": work_of("one")}).start()
    job = one.jobs.submit("walk", "lab", arguments={})
    here = one.jobs.submit("alone", "yard", lambda _: {"never": held.wait(60)})
    while not seen:
        time.sleep(0.01)
    other = Service(quick, tmp_path / "other", {"walk": work_of("other")}).start()
    one.fall_silent()
    began = time.monotonic()
    ended = end_of(other.jobs, job)
    assert time.monotonic() - began < 10
    assert (ended.state, ended.attempt, ended.result) == ("succeeded", 2, {"by": "other"})
    assert seen == [("one", 1, None), ("other", 2, 1)]
    lost = end_of(other.jobs, here)
    assert lost.state == "failed" and lost.problem is not None and lost.problem["type"].endswith("job-lost")
    held.set()  # what the first one writes now does not count
    one.close()
    assert other.jobs.get(job.id) == ended
    other.close()


@pytest.mark.thorough
def test_a_killed_service(database: SharedDatabase, tmp_path: Path) -> None:
    (tmp_path / "killed").mkdir()
    command = [sys.executable, "-m", "tests.service.jobs.worker", database.address, str(tmp_path / "killed")]
    process = subprocess.Popen(command, cwd=ROOT)
    service = Service(database.address, tmp_path / "here", {"walk": walk})
    job = service.jobs.submit("walk", "lab", arguments={})
    while (step := service.jobs.get(job.id).notes.get("step", 0)) < 3:
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    service.start()
    began = time.monotonic()
    ended = end_of(service.jobs, job)
    seconds = time.monotonic() - began
    print(f"taken over and done {seconds:.1f} s after the kill")
    assert ended.result is not None and ended.result["attempt"] == 2 and ended.result["from"] >= step
    assert seconds < 30  # by the clocks 12 s at most, on a machine that has nothing else to do
    service.close()


@pytest.mark.thorough
def test_a_job_whose_files_lie_at_one_service(quick: str, tmp_path: Path) -> None:
    ran: list[str] = []

    def bound(folder: Path, name: str) -> Service:
        def work(_: JobContext) -> Mapping[str, Any]:
            ran.append(name)
            return {}

        service = Service(quick, folder, {"other": work})
        service.jobs.register("form", work, lambda job: ran.append(f"discarded by {name}"))
        return service

    one, other = bound(tmp_path / "one", "one"), bound(tmp_path / "other", "other").start()
    form = one.jobs.submit("form", "lab", arguments={})  # before its workers run
    later = other.jobs.submit("other", "lab", arguments={})
    cancelled = one.jobs.submit("form", "hall", arguments={})
    one.replica.close()  # it is gone: nobody else does its job, and no job waits for it
    assert end_of(other.jobs, later).state == "succeeded" and ran == ["other"]
    assert other.jobs.get(form.id).state == "queued"
    assert other.jobs.cancel(cancelled.id).state == "cancelled"
    one.database.close()
    again = bound(tmp_path / "one", "one").start()
    assert end_of(other.jobs, form).state == "succeeded"
    for service in (again, other):
        service.close()
    assert list(dict.fromkeys(ran)) == ["other", "one", "discarded by one"]
