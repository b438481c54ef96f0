"""Merging over HTTP, and a merge that is interrupted: it continues after a restart, or removes what it copied."""

from __future__ import annotations

import hashlib
import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from core.errors import StorageFull
from core.ledger.maps.transfer import Transfer
from core.maps import Enrolment, MapSettings
from core.maps.records import MOST_LOOKS
from core.places import PlaceFields, look_address
from core.store import Directory
from service.app.runtime import Runtime
from service.engine.engine import Engine
from service.jobs.context import creation_time
from service.jobs.job import Job
from service.upkeep import merging
from tests.service.encoders import COARSE, TWO_STAGES, install_coarse_encoder
from tests.service.engines import ENCODER, end_of, enrolments, runtime_at, state_of
from tests.service.map_jobs import asked, enrol_frames, finished, places, reaching, wait_until
from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem, typed


def test_maps_of_both_kinds_of_coordinates_are_not_merged(server: Server) -> None:
    for name, pose in (("metres", {"x": 1, "y": 2}), ("degrees", {"latitude": 48.1, "longitude": 11.5})):
        server.create_map(name)
        assert server.enrol(name, name, jpeg(len(name)), **pose).status_code == 201
    order: dict[str, Any] = {"from": "degrees", "sample": 0}
    (conflict,) = finished(server, asked(server, "metres", "merge", **order))["result"]["conflicts"]
    assert "geographic coordinates" in conflict and "metric coordinates" in conflict
    refused = finished(server, asked(server, "metres", "merge", dry_run=False, **order))
    assert refused["state"] == "failed" and refused["problem"]["type"] == "urn:placerec:problem:mixed-coordinates"
    assert places(server, "metres").keys() == {"metres"}


@pytest.mark.thorough
def test_merging_first_reports_and_then_copies(server: Server) -> None:
    server.create_map("east", encoder=TWO_STAGES, keep="thumbnail")
    server.create_map("west", encoder=TWO_STAGES, keep="image")
    enrol_frames(server, "east", [jpeg(n) for n in range(5)], "e", sequence="monday")
    west = [encoded(seen_again(scene(n), 3)) for n in range(3, 9)]
    for n, frame in enumerate(west):
        fields: dict[str, Any] = {"x": 3 + n, "y": 0.5, "sequence": "tuesday", "metadata": {"n": n}}
        assert server.enrol("west", f"w{n}", frame, **fields).status_code == 201
    believing = {"calibration": {"threshold": 0.0, "margin": 0.0}}  # the test encoder is not calibrated
    assert server.client.patch("/v1/maps/east", json=believing).status_code == 200
    before = places(server, "east")
    report = finished(server, asked(server, "east", "merge", **{"from": "west"}))["result"]
    assert places(server, "east") == before
    assert report["coming"] == 6 and report["conflicts"] == [] and report["known"] == 0
    overlap = report["overlap"]
    assert overlap["examined"] == overlap["of"] == 6
    assert overlap["recognized"] + overlap["ambiguous"] + overlap["unknown"] == 6
    assert {"w0", "w1"} >= {pair["place"] for pair in overlap["pairs"] if pair["match"] in ("e3", "e4")} != set()
    done = finished(server, asked(server, "east", "merge", dry_run=False, **{"from": "west"}))
    assert done["state"] == "succeeded" and done["result"]["places"] == 11, done
    after, theirs = places(server, "east"), places(server, "west")
    assert {name: place for name, place in after.items() if name in before} == before
    assert {name: place for name, place in after.items() if name in theirs} == theirs, (
        "with everything that is stored of them"
    )
    for n, frame in enumerate(west):
        assert server.query("east", frame)["matches"][0]["place"]["id"] == f"w{n}"
    assert server.client.get("/v1/maps/east/places/w0/thumbnail").status_code == 200
    assert server.client.post("/v1/maps/east/verify").json()["ok"]
    again = finished(server, asked(server, "east", "merge", dry_run=False, **{"from": "west"}))["result"]
    assert again["coming"] == 0 and again["known"] == 6 and again["places"] == 11, "merging twice copies nothing again"


def conflicting(server: Server, one: str, other: str) -> None:
    for name, shift in ((one, 0), (other, 10)):
        server.create_map(name, encoder=COARSE)
        polygon = [[0, 0.9], [1, 0.9], [1, 1 - shift / 100]]
        lens = {"width": 64, "height": 48, "fx": 50 + shift, "fy": 50, "cx": 31.5, "cy": 23.5}
        camera = {"mask": {"polygons": [polygon]}, "intrinsics": lens}
        assert server.client.put(f"/v1/maps/{name}/cameras/front", json=camera).status_code == 201
        enrol_frames(server, name, [jpeg(n + shift) for n in range(3)], sequence="monday", camera="front")


def test_conflicts_are_refused_renamed_or_skipped(server: Server) -> None:
    conflicting(server, "ours", "theirs")
    refused = server.client.post("/v1/maps/ours/merge", json={"from": "theirs", "dry_run": False})
    problem = assert_problem(refused, 409, "merge-conflict")
    assert "3 ids" in problem["detail"] and "monday" in problem["detail"] and "front" in problem["detail"]
    report = finished(server, asked(server, "ours", "merge", **{"from": "theirs"}))["result"]
    assert len(report["conflicts"]) == 3
    before = places(server, "ours")

    skipping = {"from": "theirs", "on_conflict": "skip", "dry_run": False}
    done = finished(server, asked(server, "ours", "merge", **skipping))
    assert done["result"]["skipped"] == {"count": 3, "places": ["p0", "p1", "p2"]} and done["result"]["coming"] == 0
    assert places(server, "ours") == before

    renaming = {"from": "theirs", "on_conflict": "rename", "prefix": "t.", "dry_run": False}
    done = finished(server, asked(server, "ours", "merge", **renaming))
    assert done["state"] == "succeeded", done
    assert done["result"]["renamed"] == {
        "places": 3,
        "sequences": {"monday": "t.monday"},
        "cameras": {"front": "t.front"},
    }
    after = places(server, "ours")
    assert list(after) == ["p0", "p1", "p2", "t.p0", "t.p1", "t.p2"]
    assert after["t.p1"]["sequence"] == "t.monday" and after["t.p1"]["camera"] == "t.front"
    copy, original = (
        server.client.get(f"/v1/maps/{m}/cameras/{c}").json() for m, c in (("ours", "t.front"), ("theirs", "front"))
    )
    assert (copy["mask"], copy["intrinsics"]) == (original["mask"], original["intrinsics"])
    assert copy["intrinsics"]["fx"] == 60


def test_sequences_of_one_name_are_joined_in_order_when_skipping(server: Server) -> None:
    for name, first in (("head", 0), ("tail", 3)):
        server.create_map(name, encoder=COARSE, same_place_frames=1)
        for n in range(first, first + 3):
            assert server.enrol(name, f"p{n}", jpeg(n), sequence="monday").status_code == 201
    done = finished(server, asked(server, "head", "merge", dry_run=False, on_conflict="skip", **{"from": "tail"}))
    assert done["state"] == "succeeded" and done["result"]["places"] == 6
    report = server.client.get("/v1/maps/head/health").json()
    assert report["places"] == 6
    sequences = server.client.get("/v1/maps/head/sequences").json()["items"]
    assert [(s["name"], s["places"]) for s in sequences] == [("monday", 6)]


def test_merging_what_cannot_be_merged(server: Server, traverse: str) -> None:
    server.create_map("coarse-one", encoder=COARSE)
    post = server.client.post
    assert_problem(post("/v1/maps/coarse-one/merge", json={"from": traverse}), 409, "wrong-encoder")
    assert_problem(post("/v1/maps/coarse-one/merge", json={"from": "coarse-one"}), 422, "invalid-request")
    assert_problem(post("/v1/maps/coarse-one/merge", json={"from": "none"}), 404, "unknown-map")
    assert_problem(post("/v1/maps/coarse-one/merge", json={}), 422, "invalid-request")
    assert_problem(post("/v1/maps/coarse-one/merge", json={"from": "x", "prefix": "/"}), 422, "invalid-request")
    assert_problem(post("/v1/maps/coarse-one/merge", json={"from": "x", "on_conflict": "odd"}), 422, "invalid-request")


MANY = 640


@pytest.mark.thorough
def test_a_kill_in_the_middle_of_a_merge(tmp_path: Path) -> None:
    install_coarse_encoder(tmp_path / "models")
    with runtime_at(tmp_path) as runtime:
        identity = runtime.engine.resolve(COARSE)
        encoder = next(one for one in runtime.engine.catalogue.describe() if one.identity == identity)
        settings = MapSettings(keep="thumbnail")
        for name, first, count, sequence in (("lab", 1, 64, "monday"), ("hall", 1001, MANY, "tuesday")):
            map_ = runtime.engine.maps.create(name, identity, encoder.dimension, settings, encoder.local_shape)
            map_.enrol(enrolments(first, count, name[0], sequence, encoder.dimension))
    server = Server(tmp_path).wait()
    answered = 0

    def ask() -> None:
        """A robot that queries without a pause: the merge gives way to each query, and so takes long."""
        nonlocal answered
        with suppress(httpx.TransportError), httpx.Client(base_url=server.client.base_url, timeout=60) as client:
            while client.post("/v1/maps/lab/query", content=jpeg(3), headers=typed(jpeg(3))).status_code == 200:
                answered += 1

    robots = [threading.Thread(target=ask) for _ in range(3)]
    for robot in robots:
        robot.start()
    wait_until(lambda: answered >= len(robots))  # all of them have begun
    before = answered
    job = asked(server, "lab", "merge", dry_run=False, sample=0, **{"from": "hall"})
    reaching(server, job, 64)
    wait_until(lambda: answered > before + len(robots))
    going = server.client.get(f"/v1/jobs/{job['id']}").json()
    server.kill()
    assert going["state"] == "running" and going["progress"]["done"] < MANY, (going, answered - before)
    for robot in robots:
        robot.join(60)
    server = Server(tmp_path).wait()
    done = finished(server, job)
    assert (done["state"], done["attempt"]) == ("succeeded", 2), done
    here, there = places(server, "lab"), places(server, "hall")
    assert len(here) == 64 + MANY == done["result"]["places"]
    assert {name: here[name] for name in there} == there
    assert server.client.post("/v1/maps/lab/verify").json()["ok"]
    assert server.stop() == 0


# Interrupted, without HTTP

COUNT = 5 * merging.PLACES_PER_COMMIT
WANTED: dict[str, Any] = {"from": "hall", "dry_run": False, "on_conflict": "rename", "prefix": "h.", "sample": 0}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two maps that share the name of a sequence and the id of a place."""
    with runtime_at(tmp_path) as runtime:
        for name, first, count in (("lab", 1, 70), ("hall", 1001, COUNT)):
            map_ = runtime.engine.maps.create(name, ENCODER, 8, MapSettings(keep="thumbnail"))
            map_.enrol(enrolments(first, count, name[0], "monday"))
        runtime.engine.maps.get("hall").enrol(enrolments(5000, 1, "l", "monday"))
        one = Enrolment("l5000", PlaceFields(), np.ones(8, np.float32), 1, b"\x01" * 32)
        runtime.engine.maps.get("lab").enrol([one])
    return tmp_path


def after_two_commits(monkeypatch: pytest.MonkeyPatch, happens: Callable[[Any], object], commits: int = 2) -> None:
    """Let something happen in the middle of the merge, or after another number of commits, once."""
    copy, calls = merging._copy, 0

    def counted(context: Any, *arguments: Any) -> list[str]:
        nonlocal calls
        calls += 1
        if calls == commits + 1:
            happens(context)
        return copy(context, *arguments)

    monkeypatch.setattr(merging, "_copy", counted)


def merged(runtime: Runtime) -> Job:
    """The job that merges the two maps, when it has ended."""
    return end_of(runtime, runtime.jobs.submit(merging.KIND, "lab", arguments=WANTED))


def check_merged(engine: Engine, before: list[tuple[Any, ...]], theirs: list[tuple[Any, ...]]) -> None:
    here = state_of(engine, "lab")
    assert here[: len(before)] == before
    came = here[len(before) :]
    assert len(came) == len(theirs) == COUNT + 1
    for (place, *content), (other, *its_content) in zip(came, theirs, strict=True):
        name = "h.l5000" if other.id == "l5000" else other.id
        assert place == other.model_copy(update={"id": name, "sequence": "h.monday"})
        assert content == its_content
    assert engine.maps.verify("lab").ok


def test_all_places_are_copied(folder: Path) -> None:
    with runtime_at(folder) as runtime:
        before, theirs = state_of(runtime.engine, "lab"), state_of(runtime.engine, "hall")
        done = merged(runtime)
        assert done.state == "succeeded" and done.result is not None
        assert done.result["renamed"] == {"places": 1, "sequences": {"monday": "h.monday"}, "cameras": {}}
        check_merged(runtime.engine, before, theirs)
    with runtime_at(folder) as runtime:
        check_merged(runtime.engine, before, theirs)


@pytest.mark.thorough
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
            runtime.engine.maps.get("lab").enrol(own)
            runtime.jobs.cancel(context.id)

        after_two_commits(monkeypatch, cancel)
        job = runtime.jobs.submit(merging.KIND, "lab", arguments=WANTED)
        assert end_of(runtime, job).state == "cancelled"
        here = state_of(runtime.engine, "lab")
        assert here[: len(before)] == before
        assert [entry[0].id for entry in here[len(before) :]] == ["robot9000", "robot9001"]
        assert runtime.engine.maps.verify("lab").ok


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


@pytest.mark.thorough
@pytest.mark.parametrize("when", ["meanwhile", "while the service is stopped"])
def test_the_other_map_is_deleted_in_the_middle(folder: Path, monkeypatch: pytest.MonkeyPatch, when: str) -> None:
    with runtime_at(folder) as runtime:
        before = state_of(runtime.engine, "lab")

        def vanish(_: Any) -> None:
            if when == "meanwhile":
                runtime.engine.maps.delete("hall")
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


@pytest.mark.thorough
def test_the_map_itself_is_deleted_in_the_middle(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with runtime_at(folder) as runtime:
        after_two_commits(monkeypatch, lambda _: runtime.engine.maps.delete("lab"))
        failed = merged(runtime)
        assert failed.state == "failed" and failed.problem is not None
        assert failed.problem["type"] == "urn:placerec:problem:unknown-map", "no copied place remains"


def test_a_place_that_changes_in_the_other_map_meanwhile_is_copied_as_it_is_then(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with runtime_at(folder) as runtime:
        hall = runtime.engine.maps.get("hall")
        (newer,) = enrolments(7000, 1, "h", "monday")
        last = f"h{1000 + COUNT}"

        def change(_: Any) -> None:
            hall.enrol([Enrolment(last, newer.fields, newer.descriptor, 5, newer.digest, thumbnail=b"newer")])
            hall.forget("h1200")

        after_two_commits(monkeypatch, change)
        done = merged(runtime)
        assert done.state == "succeeded"
        lab = runtime.engine.maps.get("lab")
        assert lab.digest(last) == newer.digest and lab.picture(last) == b"newer"
        assert runtime.engine.maps.verify("lab").ok
        assert lab.place(last).created_at <= datetime.now(UTC) + timedelta(seconds=1)


def look_of(place_id: str, number: int) -> Enrolment:
    (made,) = enrolments(number, 1, "look", "monday")
    digest = hashlib.sha256(made.digest).digest()
    return replace(made, id=look_address(place_id, digest.hex()[:16]), digest=digest)


@pytest.mark.thorough
@pytest.mark.parametrize("meanwhile", ["nothing", "deleted", "another frame", "full"])
def test_looks_come_only_to_the_places_that_they_are_of(
    folder: Path, monkeypatch: pytest.MonkeyPatch, meanwhile: str
) -> None:
    with runtime_at(folder) as runtime:
        lab, hall = runtime.engine.maps.get("lab"), runtime.engine.maps.get("hall")
        (shared,) = enrolments(8000, 1, "both", "sunday")
        for map_ in (lab, hall):
            map_.enrol([replace(shared, fields=PlaceFields())])
        hall.enrol([look_of("both8000", 8001)])

        def change(_: Any) -> None:
            if meanwhile == "deleted":
                lab.forget("both8000")
            elif meanwhile == "another frame":
                lab.enrol([replace(enrolments(8002, 1, "x", "sunday")[0], id="both8000")])
            elif meanwhile == "full":
                lab.enrol([look_of("both8000", 8100 + number) for number in range(MOST_LOOKS)])

        after_two_commits(monkeypatch, change)
        done = merged(runtime)
        assert done.state == "succeeded" and done.result is not None, done
        comes = meanwhile == "nothing"
        assert (done.result["coming"], done.result["looks"]) == (COUNT + 1, int(comes))
        looks = [] if meanwhile == "deleted" else [look.name for look in lab.looks("both8000")]
        assert (look_of("both8000", 8001).id.rpartition("/")[2] in looks) == comes
        assert runtime.engine.maps.verify("lab").ok


@pytest.mark.thorough
@pytest.mark.parametrize("commits", [0, 2])
@pytest.mark.parametrize("theirs", ["monday", "tuesday"])
def test_what_is_enrolled_into_a_sequence_meanwhile_is_at_other_positions(
    folder: Path, monkeypatch: pytest.MonkeyPatch, commits: int, theirs: str
) -> None:
    with runtime_at(folder) as runtime:
        lab, hall = runtime.engine.maps.get("lab"), runtime.engine.maps.get("hall")
        for number in range(COUNT):
            hall.patch(f"h{1001 + number}", {"sequence": theirs})
        own = enrolments(9000, 90, "robot", theirs)
        after_two_commits(monkeypatch, lambda _: lab.enrol(own), commits)
        done = end_of(runtime, runtime.jobs.submit(merging.KIND, "lab", arguments=WANTED | {"on_conflict": "skip"}))
        assert done.state == "succeeded"
        outline = [place for place in lab.transfer.outline() if place.sequence == theirs]
        copied = [place.ordinal for place in outline if place.id.startswith("h")]
        meanwhile = [place.ordinal for place in outline if place.id.startswith("robot")]
        assert len(meanwhile) == 90 and not set(copied) & set(meanwhile)
        there = [place.ordinal for place in hall.transfer.outline() if place.id.startswith("h")]
        assert len({here - other for here, other in zip(copied, there, strict=True)}) == 1, "the traverse is whole"
        assert max(copied) < min(meanwhile) if commits else max(meanwhile) < min(copied)


@pytest.mark.thorough
@pytest.mark.parametrize("rule", ["rename", "skip"])
def test_a_place_that_somebody_enrols_meanwhile_is_never_replaced(
    folder: Path, monkeypatch: pytest.MonkeyPatch, rule: str
) -> None:
    with runtime_at(folder) as runtime:
        lab, last = runtime.engine.maps.get("lab"), f"h{1000 + COUNT}"
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
        assert runtime.engine.maps.verify("lab").ok


@pytest.mark.thorough
@pytest.mark.parametrize("which", ["lab", "hall"])
def test_it_does_not_go_on_into_another_map_of_the_same_id(
    folder: Path, monkeypatch: pytest.MonkeyPatch, which: str
) -> None:
    with runtime_at(folder) as runtime:
        before = state_of(runtime.engine, "lab")
        maps = {name: creation_time(runtime.engine.maps.get(name)) for name in ("lab", "hall")}
        after_two_commits(monkeypatch, lambda _: runtime.jobs.stop_soon())
        job = runtime.jobs.submit(merging.KIND, "lab", arguments=WANTED, maps=maps)
        wait_until(lambda: runtime.jobs.stopping)
    atlas = Directory(folder / "data")
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
