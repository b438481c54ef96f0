"""What a run has left in a map goes with the run: looks that it taught, its proposals, and lessons that wait."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from core.belief.evidence import NOTHING
from core.judgement.trials import StagedTrials, Trial, gathered
from core.judgement.verdict import Judgement
from core.learning import RunFrame, Witness
from core.maps import ReviewSetting
from core.maps.records import Enrolment
from core.places import PlaceFields, look_address
from core.store import Map
from service.access.audit import ASKER
from service.app.runtime import Runtime
from service.jobs.context import creation_time
from service.learning.run_notes import NotedFrame, RunNotes
from service.queries.histories.run_trials import RunTrials
from service.queries.statistics import map_key
from service.sessions.schemas import NewSession
from service.upkeep import erasure
from tests.service.engines import ENCODER, end_of, enrolments, runtime_at

VISIT = datetime(2026, 11, 20, 14, 30, tzinfo=UTC)
ROBOT = Witness("robot", VISIT)
DOUBTED = Judgement("unknown", 0.1, 0.02, None, None)
HOUR = {"after": "2026-11-20T14:00:00Z", "before": "2026-11-20T15:00:00Z"}


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[Runtime]:
    with runtime_at(tmp_path) as runtime:
        yield runtime


@pytest.fixture
def lab(runtime: Runtime) -> Map:
    made = runtime.engine.maps.create("lab", ENCODER, 8)
    made.enrol(enrolments(0, 6, "p", "monday"))
    made.edit({"learning": {"mode": "propose", "least_probability": 0.95, "most_looks": 3}})
    return made


def learnt(number: int, run: str | None, taken: datetime | None, camera: str | None = None) -> Enrolment:
    """A look of ``p1`` that a map has learnt."""
    (made,) = enrolments(number, 1, "x", "monday")
    address = look_address("p1", made.digest.hex()[-16:])
    fields = PlaceFields(timestamp=taken, camera=camera)
    return replace(made, id=address, fields=fields, run=run, least=None if run is None else 0.5)


def proposed(lab: Map, name: str, run: str, taken: datetime | None, place: str = "p2") -> None:
    proposal = {"place": place, "run": run, "taken": None if taken is None else taken.isoformat()}
    answer = {"best": "p4", "session": None, "camera": None, "proposal": proposal}
    assert lab.review.keep(name.encode(), answer, ReviewSetting())


def waiting(lab: Map) -> list[bytes]:
    return sorted(lab.review.picture(frame.number) for frame in lab.review.page(None, 100).frames)


def looks(lab: Map) -> set[str | None]:
    return {look.run for _, look in lab.all_looks(None, 100)[0]}


def erase(runtime: Runtime, lab: Map, **order: Any) -> dict[str, Any]:
    given = {"ids": None, "filter": None, "session": None, **order}
    made = {lab.record.id: creation_time(lab)}
    job = end_of(runtime, runtime.jobs.submit(erasure.KIND, lab.record.id, arguments=given, maps=made))
    assert job.state == "succeeded" and job.result is not None, job
    return dict(job.result)


def test_a_run_goes_with_all_that_it_has_taught(runtime: Runtime, lab: Map) -> None:
    lab.enrol([learnt(20, "s-1", VISIT), learnt(21, "s-2", VISIT), learnt(22, None, None)])
    proposed(lab, "of the run", "s-1", VISIT)
    proposed(lab, "of another", "s-2", VISIT)
    # A person has made a proposal of the run a look of another place than it was proposed for.
    proposed(lab, "labelled", "s-1", None)
    (made,) = enrolments(30, 1, "x", "monday")
    lab.enrol([replace(made, id=look_address("p3", "0" * 15 + "7"))])
    number = lab.review.page(None, 1).frames[0].number
    lab.review.label(number, {"label": {"place": "p3", "look": "0" * 15 + "7"}, "by": "anna"})
    result = erase(runtime, lab, session="s-1")
    assert (result["places"], result["looks"], result["review"]) == (0, 2, 2)
    assert looks(lab) == {"s-2", None} and waiting(lab) == [b"of another"]
    assert lab.place("p3").looks == 0 and lab.place("p1").looks == 2 and lab.count_places() == 6


def test_new_ground_goes_with_its_run_and_so_do_stretches_that_wait(runtime: Runtime, lab: Map) -> None:
    lab.enrol([replace(one, run="s-1", least=0.5) for one in enrolments(40, 2, "g", "s-1-3f2a90c1")])
    for run in ("s-1", "s-2"):
        answer = {"best": None, "session": None, "camera": None, "stretch": {"run": run, "taken": VISIT.isoformat()}}
        assert lab.review.keep(run.encode(), answer, ReviewSetting())
    result = erase(runtime, lab, session="s-1")
    assert (result["places"], result["review"]) == (2, 1)
    assert waiting(lab) == [b"s-2"] and lab.count_places() == 6


def test_proposals_go_by_the_time_at_which_they_were_taken_and_with_their_place(runtime: Runtime, lab: Map) -> None:
    lab.enrol([learnt(20, "s-1", VISIT), learnt(21, "s-1", VISIT + timedelta(hours=1))])
    proposed(lab, "visit", "s-1", VISIT)
    proposed(lab, "later", "s-1", VISIT + timedelta(hours=1))
    proposed(lab, "of place", "s-1", VISIT + timedelta(hours=1), "p5")
    assert erase(runtime, lab, filter={**HOUR, "sequence": None, "camera": None, "where": None})["looks"] == 1
    assert waiting(lab) == [b"later", b"of place"]
    now = {"after": (datetime.now(UTC) - timedelta(hours=1)).isoformat(), "before": None}
    erase(runtime, lab, filter={**now, "sequence": None, "camera": None, "where": None})
    assert len(waiting(lab)) == 2, "they were stored an hour ago, but not taken"
    assert erase(runtime, lab, ids=["p5"])["review"] == 1 and waiting(lab) == [b"later"]


def notes_of(session: str, taken: datetime) -> RunNotes:
    notes = RunNotes(session, ASKER.get(), ROBOT)
    frame = RunFrame(NOTHING, "unknown", None, None, None, None)
    for _ in range(8):
        assert notes.add(NotedFrame(frame, b"frame", taken, {"camera": "front"}))
    return notes


@pytest.mark.parametrize(
    "order",
    [
        {"session": "s-1"},
        {"filter": {**HOUR, "sequence": None, "camera": None, "where": None}},
        {"filter": {"after": None, "before": None, "sequence": None, "camera": "front", "where": None}},
    ],
)
def test_a_lesson_that_waits_behind_an_erasure_teaches_nothing(
    runtime: Runtime, lab: Map, order: dict[str, Any]
) -> None:
    """Services that have notes of their own of a run find the order among the jobs that they share."""
    session = runtime.sessions.create(lab, NewSession())
    erase(runtime, lab, **order)
    notes, others = notes_of("s-1", VISIT), notes_of("s-2", datetime.now(UTC) + timedelta(hours=1))
    runtime._learn(session, notes)
    (job,) = [job for job in runtime.jobs.all() if job.kind == "learn"]
    result = end_of(runtime, job).result
    assert result is not None and result["contradiction"] == "erased" and not notes.frames
    made = creation_time(lab)
    assert not erasure.concerns(runtime.jobs, "lab", made, others)
    assert not erasure.concerns(runtime.jobs, "lab", "another map of this id", notes_of("s-1", VISIT))


def test_what_a_run_said_of_the_calibration_goes_with_it(runtime: Runtime, lab: Map) -> None:
    session = runtime.sessions.create(lab, NewSession())
    trials = gathered([Trial(DOUBTED, True, True, 0)])
    for run in (session.id, "s-other"):
        runtime.statistics.keep_run_trials(map_key(lab), RunTrials(run, ROBOT, StagedTrials.of(trials)))
    erase(runtime, lab, session=session.id)
    assert [one.run for one in runtime.statistics.run_trials(map_key(lab))] == ["s-other"]
