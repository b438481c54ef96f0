"""Jobs without HTTP: their order and their end, a restart of the service, a disk that refuses, and time slices."""

from __future__ import annotations

import re
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from core.errors import DataDirectoryTooNew, DataDirectoryTooOld, StorageFailure, UnknownMap
from core.ledger.sqlite import SqliteLedger
from service.access.audit import ASKER, Asker
from service.errors.faults import JobEnded, JobQueueFull, TooManyWatchers, UnknownJob
from service.fairness import CALLER
from service.jobs.context import JobContext
from service.jobs.file import FILE
from service.jobs.jobs import Jobs
from service.jobs.rows import TABLES
from service.shared.database import SharedDatabase
from tests.service.jobs.services import Gate, Kinds, Running, Service, end_of, running_alone


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=[pytest.mark.postgres, pytest.mark.thorough])])
def running(request: pytest.FixtureRequest) -> Running:
    """Runs the jobs of a service that is alone, or of one that could share them."""
    if request.param == "sqlite":
        return running_alone
    database: SharedDatabase = request.getfixturevalue("database")

    @contextmanager
    def running_shared(folder: Path, kinds: Kinds | None = None, **limits: Any) -> Iterator[Jobs]:
        service = Service(database.address, folder, kinds or {}, **limits).start()
        try:
            yield service.jobs
        finally:
            service.close()

    return running_shared


def test_a_job_runs_and_is_remembered(running: Running, tmp_path: Path) -> None:
    with running(tmp_path) as jobs:
        job = jobs.submit("sum", "lab", lambda _: {"sum": 3})
        assert job.state == "queued" and job.map_id == "lab"
        ended = end_of(jobs, job)
        assert (ended.state, ended.result, ended.attempt) == ("succeeded", {"sum": 3}, 1)
        assert ended.started_at and ended.ended_at and job.created_at <= ended.started_at <= ended.ended_at
    with running(tmp_path) as jobs:
        assert jobs.get(job.id) == ended


def test_a_failed_job_says_why_but_hides_internal_errors(running: Running, tmp_path: Path) -> None:
    def refuse(_: JobContext) -> dict[str, Any]:
        raise UnknownMap("There is no map 'lab'.")

    def break_down(_: JobContext) -> dict[str, Any]:
        raise RuntimeError("secret")

    with running(tmp_path) as jobs:
        refused = end_of(jobs, jobs.submit("refuse", None, refuse))
        broken = end_of(jobs, jobs.submit("break", None, break_down))
        no_json = end_of(jobs, jobs.submit("odd", None, lambda _: {"value": float("nan")}))
    assert refused.state == broken.state == no_json.state == "failed"
    assert refused.problem is not None and broken.problem is not None
    assert refused.problem["type"] == "urn:placerec:problem:unknown-map"
    assert refused.problem["detail"] == "There is no map 'lab'."
    assert broken.problem["type"] == "urn:placerec:problem:internal-error"
    assert "secret" not in str(broken)


def test_jobs_take_turns_and_the_queue_is_bounded(running: Running, tmp_path: Path) -> None:
    gate, order = Gate(), list[int]()

    def noting(number: int) -> Callable[[JobContext], dict[str, Any]]:
        def note(_: JobContext) -> dict[str, Any]:
            order.append(number)
            return {}

        return note

    with running(tmp_path, longest_queue=2) as jobs:
        first = jobs.submit("gate", None, gate)
        assert gate.begun.wait(60)
        waiting = [jobs.submit("note", None, noting(number)) for number in range(2)]
        refusals: list[Callable[[], object]] = [lambda: jobs.submit("note", None, lambda _: {})]
        if jobs._peers.alone:  # services that share a ledger count its jobs now and then
            refusals.append(jobs.check_room)
        for refused in refusals:
            with pytest.raises(JobQueueFull):
                refused()
        assert [jobs.get(job.id).state for job in (first, *waiting)] == ["running", "queued", "queued"]
        token = ASKER.set(Asker("robot", "key-of-another"))
        jobs.check_room()
        waiting.append(jobs.submit("note", None, noting(2)))
        for refused in refusals:
            with pytest.raises(JobQueueFull):  # it has its half
                refused()
        ASKER.reset(token)
        gate.open.set()
        assert [end_of(jobs, job).state for job in waiting] == ["succeeded"] * 3
    assert order == [0, 1, 2]


def test_two_workers_never_work_on_one_map(running: Running, tmp_path: Path) -> None:
    first, other = Gate(), Gate()
    with running(tmp_path, workers=2) as jobs:
        jobs.submit("gate", "lab", first)
        second = jobs.submit("note", "lab", lambda _: {})
        jobs.submit("gate", "hall", other)
        assert first.begun.wait(60) and other.begun.wait(60)
        assert jobs.get(second.id).state == "queued"
        first.open.set()
        assert end_of(jobs, second).state == "succeeded"
        other.open.set()


def test_cancelling(running: Running, tmp_path: Path) -> None:
    gate, undone = Gate(), threading.Event()

    def careful(context: JobContext) -> Mapping[str, Any]:
        try:
            return gate(context)
        finally:
            undone.set()

    with running(tmp_path) as jobs:
        job = jobs.submit("gate", None, careful)
        waiting = jobs.submit("note", None, lambda _: {})
        assert gate.begun.wait(60)
        assert jobs.cancel(waiting.id).state == "cancelled"
        assert jobs.cancel(job.id).cancelling
        assert end_of(jobs, job).state == "cancelled" and undone.is_set()
        assert jobs.cancel(job.id).state == "cancelled", "cancelling twice is no error"
        done = end_of(jobs, jobs.submit("note", None, lambda _: {}))
        with pytest.raises(JobEnded):
            jobs.cancel(done.id)
        with pytest.raises(UnknownJob):
            jobs.cancel("none")


def test_a_job_interrupted_by_a_stop_is_resumed_at_the_next_start(running: Running, tmp_path: Path) -> None:
    gate = Gate()
    with running(tmp_path, {"gate": gate}) as jobs:
        job = jobs.submit("gate", "lab", arguments={"to": "hall"})
        waiting = jobs.submit("gate", None, arguments={"number": 2})
        lost = jobs.submit("note", None, lambda _: {})
        assert gate.begun.wait(60)
    gate.open.set()
    with running(tmp_path, {"gate": gate}) as jobs:
        again = end_of(jobs, job)
        assert (again.state, again.attempt, again.result) == ("succeeded", 2, {"passed": {"to": "hall"}})
        assert end_of(jobs, waiting).result == {"passed": {"number": 2}}
        failed = jobs.get(lost.id)
        assert failed.state == "failed" and failed.problem is not None
        assert failed.problem["type"] == "urn:placerec:problem:job-lost"


def test_a_job_that_cannot_be_resumed_fails_when_the_service_stops(running: Running, tmp_path: Path) -> None:
    gate = Gate()
    with running(tmp_path) as jobs:
        job = jobs.submit("gate", None, gate)
        assert gate.begun.wait(60)
    with running(tmp_path) as jobs:
        failed = jobs.get(job.id)
        assert failed.state == "failed" and failed.problem is not None
        assert failed.problem["type"] == "urn:placerec:problem:job-lost"


def test_a_resumed_job_has_its_notes_and_is_still_cancelled(running: Running, tmp_path: Path) -> None:
    begun = threading.Event()
    seen: list[tuple[Mapping[str, Any], bool]] = []

    def noting(context: JobContext) -> dict[str, Any]:
        seen.append((context.notes, context.cancelled))
        context.remember(plan=["a", "b"])
        begun.set()
        while context.attempt == 1 and not jobs.stopping:  # deaf to being cancelled
            time.sleep(0.005)
        context.check_cancelled()
        return {}

    with running(tmp_path, {"note": noting}) as jobs:
        job = jobs.submit("note", None, arguments={})
        assert begun.wait(60)
        assert jobs.cancel(job.id).cancelling
    with running(tmp_path, {"note": noting}) as jobs:
        assert end_of(jobs, job).state == "cancelled"
    assert seen == [({}, False), ({"plan": ["a", "b"]}, True)]


def test_the_history_is_bounded(running: Running, tmp_path: Path) -> None:
    with running(tmp_path, history=3) as jobs:
        made = [end_of(jobs, jobs.submit("note", None, lambda _: {})) for _ in range(6)]
        assert [job.id for job in jobs.all()] == [job.id for job in made[3:]]
        with pytest.raises(UnknownJob):
            jobs.get(made[0].id)
    with running(tmp_path, history=3) as jobs:
        assert [job.number for job in jobs.all()] == [4, 5, 6]
        assert jobs.submit("note", None, lambda _: {}).number == 7


def test_progress_grows_and_its_versions_differ(running: Running, tmp_path: Path) -> None:
    gate, versions = Gate(), set()
    with running(tmp_path) as jobs:
        job = jobs.submit("gate", None, gate)
        versions.add(job.version)
        assert gate.begun.wait(60)
        now = jobs.get(job.id)
        assert (now.done, now.total, now.message) == (1, 4, "at the gate")
        versions.add(now.version)
        gate.open.set()
        versions.add(end_of(jobs, job).version)
    assert len(versions) == 3


@pytest.mark.anyio
async def test_watchers_are_bounded(running: Running, tmp_path: Path) -> None:
    gate = Gate()
    with running(tmp_path, most_watchers=1) as jobs:
        job = jobs.submit("gate", None, gate)
        with jobs.watchers.watching(job.id) as changed:
            with pytest.raises(TooManyWatchers), jobs.watchers.watching(job.id):
                pass
            token = CALLER.set("robot")
            with pytest.raises(TooManyWatchers), jobs.watchers.watching(job.id):
                pass
            assert not changed.over, "nobody has more than one"
            CALLER.reset(token)
            gate.open.set()
            await changed.wait()
        with jobs.watchers.watching(job.id):
            pass


@pytest.mark.anyio
async def test_the_caller_with_most_watchers_gives_way_to_another(running: Running, tmp_path: Path) -> None:
    gate = Gate()
    with running(tmp_path, most_watchers=2) as jobs:
        job = jobs.submit("gate", None, gate)
        with jobs.watchers.watching(job.id) as first, jobs.watchers.watching(job.id) as second:
            token = CALLER.set("robot")
            with jobs.watchers.watching(job.id) as other:
                assert second.over and second.is_set() and not first.over and not other.over
            CALLER.reset(token)
        gate.open.set()


def test_a_damaged_file_is_put_aside(tmp_path: Path) -> None:
    (tmp_path / FILE).write_bytes(b"this is no database" * 100)
    with running_alone(tmp_path) as jobs:
        assert jobs.all() == []
        assert end_of(jobs, jobs.submit("note", None, lambda _: {})).state == "succeeded"
    assert len(list(tmp_path.glob(f"{FILE}.damaged-*"))) == 1


@pytest.mark.parametrize(
    ("version", "refusal"),
    [(TABLES.version + 1, DataDirectoryTooNew), (1, DataDirectoryTooOld), (TABLES.version - 1, DataDirectoryTooOld)],
)
def test_a_file_of_another_version_is_refused(tmp_path: Path, version: int, refusal: type[Exception]) -> None:
    with running_alone(tmp_path):
        pass
    connection = sqlite3.connect(tmp_path / FILE)
    connection.execute(f"PRAGMA user_version = {version}")
    connection.close()
    before = (tmp_path / FILE).read_bytes()
    with pytest.raises(refusal, match=re.escape(f"{tmp_path / FILE} was written")):
        Jobs.of_directory(tmp_path)
    assert (tmp_path / FILE).read_bytes() == before


def driver_of(jobs: Jobs) -> sqlite3.Connection:
    """The connection to the file of jobs, by which it can be made to refuse writes."""
    ledger = jobs._table._ledger
    assert isinstance(ledger, SqliteLedger)
    return ledger._connection.driver


def test_jobs_go_on_while_the_disk_refuses(tmp_path: Path) -> None:
    gate = Gate()
    kinds: Kinds = {"note": lambda _: {}}
    with running_alone(tmp_path, kinds) as jobs:
        job, waiting = jobs.submit("gate", None, gate), jobs.submit("note", None)
        assert gate.begun.wait(60)
        driver_of(jobs).execute("PRAGMA query_only = ON")
        with pytest.raises(StorageFailure):
            jobs.submit("note", None)
        with pytest.raises(StorageFailure):
            jobs.cancel(job.id)
        gate.open.set()
        ended = end_of(jobs, job)
        assert ended.state == "succeeded" and not ended.cancelling
        assert [found.id for found in jobs.all()] == [job.id, waiting.id], "what was refused is not there"
        assert jobs.all()[0] == ended
        driver_of(jobs).execute("PRAGMA query_only = OFF")
        assert end_of(jobs, waiting).state == "succeeded"
    with running_alone(tmp_path, kinds) as jobs:
        assert jobs.get(job.id) == ended, "its end was written when the disk took it"


def test_jobs_are_resumed_when_the_disk_takes_it_at_last(tmp_path: Path) -> None:
    gate = Gate()
    with running_alone(tmp_path, {"gate": gate}) as jobs:
        job = jobs.submit("gate", "lab")
        assert gate.begun.wait(60)
        driver_of(jobs).execute("PRAGMA query_only = ON")  # it stays a running one
    gate.open.set()
    jobs = Jobs.of_directory(tmp_path)
    jobs.register("gate", gate)
    driver_of(jobs).execute("PRAGMA query_only = ON")
    jobs.start()
    assert jobs.get(job.id).state == "running"
    driver_of(jobs).execute("PRAGMA query_only = OFF")
    ended = end_of(jobs, job)
    assert (ended.state, ended.attempt) == ("succeeded", 2)
    jobs.close()


def test_notes_that_the_disk_refuses_fail_the_job(tmp_path: Path) -> None:
    with running_alone(tmp_path) as jobs:

        def noting(context: JobContext) -> Mapping[str, Any]:
            driver_of(jobs).execute("PRAGMA query_only = ON")
            try:
                context.remember(step=1)
            finally:
                driver_of(jobs).execute("PRAGMA query_only = OFF")
            return {}

        failed = end_of(jobs, jobs.submit("note", None, noting))
        assert failed.problem is not None and failed.problem["type"] == "urn:placerec:problem:storage-failure"


def test_a_job_of_an_unknown_kind_fails_at_the_start(running: Running, tmp_path: Path) -> None:
    gate, discarded = Gate(), list[str]()
    with running(tmp_path, {"gate": gate}, shared_maps=False) as jobs:
        job = jobs.submit("gate", "lab", arguments={"form": "f"})
        assert gate.begun.wait(60)
    with running(tmp_path, {"other": gate}, shared_maps=False) as jobs:
        failed = jobs.get(job.id)
        assert failed.state == "failed" and failed.problem is not None
        assert failed.problem["type"] == "urn:placerec:problem:job-lost" and "gate" in failed.problem["detail"]
    assert not discarded


@pytest.mark.parametrize("how", ["a record", "the file"])
def test_jobs_of_damaged_records_are_listed_as_lost(tmp_path: Path, how: str) -> None:
    gate = Gate()
    with running_alone(tmp_path, {"gate": gate}) as jobs:
        done = end_of(jobs, jobs.submit("note", None, lambda _: {"kept": True}))
        job = jobs.submit("gate", "lab", arguments={})
        assert gate.begun.wait(60)
    connection = sqlite3.connect(tmp_path / FILE)
    if how == "a record":
        connection.execute("UPDATE jobs SET arguments = '{' WHERE id = ?", (job.id,))
    else:
        connection.execute("CREATE TABLE foreign_one (x)")
        connection.execute("PRAGMA user_version = 0")
    connection.commit()
    connection.close()
    with running_alone(tmp_path, {"gate": gate}) as jobs:
        assert jobs.get(done.id).result == {"kept": True}
        lost = jobs.get(job.id)
        assert lost.state == "failed" and lost.problem is not None
        assert lost.problem["type"] == "urn:placerec:problem:job-lost" and "damaged" in lost.problem["detail"]
        if how == "the file":
            with pytest.raises(UnknownJob, match="put aside"):
                jobs.get("forgotten")
        gate.open.set()
        assert end_of(jobs, jobs.submit("gate", "lab", arguments={})).state == "succeeded"


def test_the_files_of_a_job_are_discarded_however_it_ends(running: Running, tmp_path: Path) -> None:
    gate, discarded = Gate(), list[str]()

    def refuse(_: JobContext) -> dict[str, Any]:
        raise UnknownMap("There is no map 'lab'.")

    with running(tmp_path) as jobs:
        for kind, work in (("gate", gate), ("refuse", refuse)):
            jobs.register(kind, work, lambda job: discarded.append(job.id))
        first, second, third = (jobs.submit(kind, None, arguments={}) for kind in ("gate", "refuse", "gate"))
        assert gate.begun.wait(60)
        jobs.cancel(third.id)
        assert discarded == [third.id], "cancelled before it began"
        gate.open.set()
        end_of(jobs, first)
        end_of(jobs, second)
    assert sorted(discarded) == sorted([first.id, second.id, third.id])


def test_a_job_fails_if_its_map_was_replaced(running: Running, tmp_path: Path) -> None:
    from core.store import Directory
    from service.jobs.context import creation_time

    atlas, gate = Directory(tmp_path / "data"), threading.Event()
    lab = atlas.create("lab", "some@" + "0" * 64, 8)

    def look(context: JobContext) -> dict[str, Any]:
        assert gate.wait(60)
        return {"places": context.map(atlas).count_places()}

    with running(tmp_path) as jobs:
        bound = jobs.submit("look", "lab", look, maps={"lab": creation_time(lab)})
        atlas.delete("lab")
        again = atlas.create("lab", "some@" + "0" * 64, 8)
        gate.set()
        failed = end_of(jobs, bound)
        assert failed.problem is not None and failed.problem["type"] == "urn:placerec:problem:unknown-map"
        rebound = jobs.submit("look", "lab", look, maps={"lab": creation_time(again)})
        assert end_of(jobs, rebound).result == {"places": 0}
    atlas.close()


# Time slices


def test_long_jobs_give_way_to_those_of_other_maps_in_turn(
    running: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.jobs.context.SLICE_SECONDS", 0.0)
    order, ready = list[str](), threading.Event()

    def stepping(context: JobContext) -> dict[str, Any]:
        assert ready.wait(60)
        while (step := context.notes.get("step", 0)) < 3:
            order.append(f"{context.map_id}{context.arguments['name']}{step}")
            context.remember(step=step + 1)
            context.give_way()
        return {}

    with running(tmp_path, {"step": stepping}) as jobs:
        maps = ["x", "y", "x"]
        made = [jobs.submit("step", name, arguments={"name": "ab"[i // 2]}) for i, name in enumerate(maps)]
        ready.set()
        assert [end_of(jobs, job).state for job in made] == ["succeeded"] * 3
    assert [step for step in order if step.startswith("x")] == ["xa0", "xa1", "xa2", "xb0", "xb1", "xb2"]
    assert order.index("ya0") < order.index("xa2") and order.index("xa1") < order.index("ya2"), order


def test_a_job_that_has_given_way_is_cancelled_at_once(
    running: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.jobs.context.SLICE_SECONDS", 0.0)
    gate, ready = Gate(), threading.Event()

    def yielding(context: JobContext) -> dict[str, Any]:
        assert ready.wait(60)
        context.give_way()
        return {}

    with running(tmp_path, {"yielding": yielding, "gate": gate}) as jobs:
        patient, other = jobs.submit("yielding", "x"), jobs.submit("gate", "y")
        ready.set()
        assert gate.begun.wait(60) and jobs.get(patient.id).attempt == 1
        assert jobs.cancel(patient.id).state == "cancelled"
        gate.open.set()
        assert end_of(jobs, other).state == "succeeded" and jobs.get(patient.id).state == "cancelled"
