"""A merge that is interrupted: it continues after a restart, or removes everything that it copied."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.errors import StorageFull
from core.places import PlaceFields
from core.storage import Atlas, Enrolment, MapSettings
from core.storage.transfer import Transfer
from service.app.runtime import Runtime
from service.engine.engine import Engine
from service.jobs.context import creation_time
from service.jobs.records import Job
from service.upkeep import merging
from tests.service.engines import ENCODER, end_of, enrolments, runtime_at, state_of
from tests.service.map_jobs import wait_until

COUNT = 5 * merging.PLACES_PER_COMMIT
WANTED: dict[str, Any] = {"from": "hall", "dry_run": False, "on_conflict": "rename", "prefix": "h.", "sample": 0}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two maps that share the name of a sequence and the id of a place."""
    with runtime_at(tmp_path) as runtime:
        for name, first, count in (("lab", 1, 70), ("hall", 1001, COUNT)):
            map_ = runtime.engine.atlas.create(name, ENCODER, 8, MapSettings(keep="thumbnail"))
            map_.enrol(enrolments(first, count, name[0], "monday"))
        runtime.engine.atlas.get("hall").enrol(enrolments(5000, 1, "l", "monday"))
        one = Enrolment("l5000", PlaceFields(), np.ones(8, np.float32), 1, b"\x01" * 32)
        runtime.engine.atlas.get("lab").enrol([one])
    return tmp_path


def after_two_commits(monkeypatch: pytest.MonkeyPatch, happens: Callable[[Any], None]) -> None:
    """Let something happen in the middle of the merge, once."""
    copy, calls = merging._copy, 0

    def counted(context: Any, *arguments: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == 3:
            happens(context)
        copy(context, *arguments)

    monkeypatch.setattr(merging, "_copy", counted)


def merged(runtime: Runtime) -> Job:
    """The job that merges the two maps, when it has ended."""
    return end_of(runtime, runtime.jobs.submit(merging.KIND, "lab", arguments=WANTED))


def check_merged(engine: Engine, before: list[tuple[Any, ...]], theirs: list[tuple[Any, ...]]) -> None:
    here = state_of(engine, "lab")
    assert here[: len(before)] == before
    came = here[len(before) :]
    assert len(came) == len(theirs) == COUNT + 1
    for (place, ordinal, picture, descriptor), (other, its_ordinal, its_picture, its_descriptor) in zip(
        came, theirs, strict=True
    ):
        name = "h.l5000" if other.id == "l5000" else other.id
        assert place == other.model_copy(update={"id": name, "sequence": "h.monday"})
        assert (ordinal, picture, descriptor) == (its_ordinal, its_picture, its_descriptor)
    assert engine.atlas.verify("lab").ok


def test_all_places_are_copied(folder: Path) -> None:
    with runtime_at(folder) as runtime:
        before, theirs = state_of(runtime.engine, "lab"), state_of(runtime.engine, "hall")
        done = merged(runtime)
        assert done.state == "succeeded" and done.result is not None
        assert done.result["renamed"] == {"places": 1, "sequences": {"monday": "h.monday"}, "cameras": {}}
        check_merged(runtime.engine, before, theirs)
    with runtime_at(folder) as runtime:
        check_merged(runtime.engine, before, theirs)


def test_a_stop_in_the_middle_and_a_start_copy_all(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with runtime_at(folder) as runtime:
        before, theirs = state_of(runtime.engine, "lab"), state_of(runtime.engine, "hall")
        after_two_commits(monkeypatch, lambda _: runtime.jobs.stop_soon())
        job = runtime.jobs.submit(merging.KIND, "lab", arguments=WANTED)
        wait_until(lambda: runtime.jobs.stopping)
    with runtime_at(folder) as runtime:
        assert end_of(runtime, job).state == "succeeded"
        assert runtime.jobs.get(job.id).attempt == 2
        check_merged(runtime.engine, before, theirs)


def test_cancelled_in_the_middle_it_leaves_what_others_enrolled(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with runtime_at(folder) as runtime:
        before = state_of(runtime.engine, "lab")
        own = enrolments(9000, 2, "robot", "tuesday")

        def cancel(context: Any) -> None:
            runtime.engine.atlas.get("lab").enrol(own)
            runtime.jobs.cancel(context.id)

        after_two_commits(monkeypatch, cancel)
        job = runtime.jobs.submit(merging.KIND, "lab", arguments=WANTED)
        assert end_of(runtime, job).state == "cancelled"
        here = state_of(runtime.engine, "lab")
        assert here[: len(before)] == before
        assert [entry[0].id for entry in here[len(before) :]] == ["robot9000", "robot9001"]
        assert runtime.engine.atlas.verify("lab").ok


def test_a_full_disk_in_the_middle_leaves_the_map_as_it_was(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(_: Any) -> None:
        raise StorageFull("The disk is full.")

    with runtime_at(folder) as runtime:
        before = state_of(runtime.engine, "lab")
        after_two_commits(monkeypatch, fill)
        failed = merged(runtime)
        assert failed.state == "failed" and failed.problem is not None
        assert failed.problem["type"] == "urn:placerec:problem:storage-full"
        assert state_of(runtime.engine, "lab") == before


def test_the_problem_says_that_copied_places_could_not_be_removed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill(_: Any) -> None:
        def refuse(*_: Any) -> int:
            raise StorageFull("No room even to forget.")

        monkeypatch.setattr(Transfer, "forget", refuse)
        raise StorageFull("The disk is full.")

    with runtime_at(folder) as runtime:
        after_two_commits(monkeypatch, fill)
        failed = merged(runtime)
        assert failed.problem is not None and "remain" in failed.problem["detail"]


@pytest.mark.parametrize("when", ["meanwhile", "while the service is stopped"])
def test_the_other_map_is_deleted_in_the_middle(folder: Path, monkeypatch: pytest.MonkeyPatch, when: str) -> None:
    with runtime_at(folder) as runtime:
        before = state_of(runtime.engine, "lab")

        def vanish(_: Any) -> None:
            if when == "meanwhile":
                runtime.engine.atlas.delete("hall")
            else:
                runtime.jobs.stop_soon()

        after_two_commits(monkeypatch, vanish)
        job = runtime.jobs.submit(merging.KIND, "lab", arguments=WANTED)
        wait_until(lambda: runtime.jobs.stopping or runtime.jobs.get(job.id).ended)
    if when != "meanwhile":
        shutil.rmtree(folder / "data" / "maps" / "hall")
    with runtime_at(folder) as runtime:
        failed = end_of(runtime, job)
        assert failed.state == "failed" and failed.problem is not None
        assert failed.problem["type"] == "urn:placerec:problem:unknown-map"
        assert state_of(runtime.engine, "lab") == before


def test_the_map_itself_is_deleted_in_the_middle(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with runtime_at(folder) as runtime:
        after_two_commits(monkeypatch, lambda _: runtime.engine.atlas.delete("lab"))
        failed = merged(runtime)
        assert failed.state == "failed" and failed.problem is not None
        assert failed.problem["type"] == "urn:placerec:problem:unknown-map", "no copied place remains"


def test_a_place_that_changes_in_the_other_map_meanwhile_is_copied_as_it_is_then(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with runtime_at(folder) as runtime:
        hall = runtime.engine.atlas.get("hall")
        (newer,) = enrolments(7000, 1, "h", "monday")
        last = f"h{1000 + COUNT}"

        def change(_: Any) -> None:
            hall.enrol([Enrolment(last, newer.fields, newer.descriptor, 5, newer.digest, thumbnail=b"newer")])
            hall.forget("h1200")

        after_two_commits(monkeypatch, change)
        done = merged(runtime)
        assert done.state == "succeeded"
        lab = runtime.engine.atlas.get("lab")
        assert lab.digest(last) == newer.digest and lab.picture(last) == b"newer"
        assert runtime.engine.atlas.verify("lab").ok
        assert lab.place(last).created_at <= datetime.now(UTC) + timedelta(seconds=1)


@pytest.mark.parametrize("rule", ["rename", "skip"])
def test_a_place_that_somebody_enrols_meanwhile_is_never_replaced(
    folder: Path, monkeypatch: pytest.MonkeyPatch, rule: str
) -> None:
    with runtime_at(folder) as runtime:
        lab, last = runtime.engine.atlas.get("lab"), f"h{1000 + COUNT}"
        before = state_of(runtime.engine, "lab")
        (own,) = enrolments(7000, 1, "h", "tuesday")

        def enrol(_: Any) -> None:
            lab.enrol([Enrolment(last, own.fields, own.descriptor, 5, own.digest, thumbnail=b"theirs")])

        after_two_commits(monkeypatch, enrol)
        done = end_of(runtime, runtime.jobs.submit(merging.KIND, "lab", arguments=WANTED | {"on_conflict": rule}))
        assert lab.digest(last) == own.digest and lab.picture(last) == b"theirs"
        if rule == "skip":
            assert done.state == "succeeded" and lab.count_places() == len(before) + COUNT
        else:
            assert done.problem is not None and done.problem["type"] == "urn:placerec:problem:merge-conflict"
            here = state_of(runtime.engine, "lab")
            assert here[:-1] == before and here[-1][0].id == last
        assert runtime.engine.atlas.verify("lab").ok


@pytest.mark.parametrize("which", ["lab", "hall"])
def test_it_does_not_go_on_into_another_map_of_the_same_id(
    folder: Path, monkeypatch: pytest.MonkeyPatch, which: str
) -> None:
    with runtime_at(folder) as runtime:
        before = state_of(runtime.engine, "lab")
        maps = {name: creation_time(runtime.engine.atlas.get(name)) for name in ("lab", "hall")}
        after_two_commits(monkeypatch, lambda _: runtime.jobs.stop_soon())
        job = runtime.jobs.submit(merging.KIND, "lab", arguments=WANTED, maps=maps)
        wait_until(lambda: runtime.jobs.stopping)
    atlas = Atlas(folder / "data")
    atlas.delete(which)
    atlas.create(which, ENCODER, 8).enrol(enrolments(8000, 3, "n", "monday"))
    atlas.close()
    with runtime_at(folder) as runtime:
        failed = end_of(runtime, job)
        assert failed.problem is not None and failed.problem["type"] == "urn:placerec:problem:unknown-map"
        if which == "hall":
            assert state_of(runtime.engine, "lab") == before, "what was copied of the deleted map is removed"
        else:
            assert [entry[0].id for entry in state_of(runtime.engine, "lab")] == ["n8000", "n8001", "n8002"]
