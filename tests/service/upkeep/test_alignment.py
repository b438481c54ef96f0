"""Aligning traverses: what is stored, what is not, and attempts that were cancelled, killed or overtaken."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from core.ledger.maps.counterparts import Counterparts
from core.maps import Enrolment, MapSettings
from core.maps.records import LearningSetting
from core.places import PlaceFields, Pose
from core.store import Map
from service.app.runtime import Runtime
from service.jobs.context import JobCancelled, JobInterrupted
from service.jobs.job import Job
from service.upkeep import alignment
from tests.service.encoders import COARSE
from tests.service.engines import ENCODER, end_of, runtime_at, state_of
from tests.service.map_jobs import asked, enrol_frames, finished, places, wait_until
from tests.service.scenes import encoded, scene, seen_again
from tests.service.server import Server, assert_problem

DIMENSION = 64
FRAMES = 40
SILENT = LearningSetting(calibration="off")
"""No encoder is loaded, so nothing is asked (``tests/service/learning/test_self_calibration.py``)."""
Vectors = NDArray[np.float32]


def walk(seed: int = 0, count: int = FRAMES) -> Vectors:
    """What the places of a way look like."""
    return np.random.default_rng(seed).normal(size=(count, DIMENSION)).astype(np.float32)


def visit(
    map_: Map, sequence: str, ways: Vectors, posed: bool = False, seed: int = 1, fields: dict[str, Any] | None = None
) -> None:
    """Enrol a traverse of some places, each of which looks a little different than last time."""
    seen = ways + np.random.default_rng(seed).normal(0, 0.7, ways.shape).astype(np.float32)
    map_.enrol(
        [
            Enrolment(
                f"{sequence}{number}",
                PlaceFields(pose=Pose(x=10 * number, y=0) if posed else None, sequence=sequence, **(fields or {})),
                descriptor / np.linalg.norm(descriptor),
                5,
                f"{sequence} {number}".encode().ljust(32),
            )
            for number, descriptor in enumerate(seen)
        ]
    )


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[Runtime]:
    with runtime_at(tmp_path) as runtime:
        yield runtime


def two_traverses(runtime: Runtime) -> Map:
    """A map of two traverses of one way, of which the second begins at the sixth place."""
    lab = runtime.engine.maps.create("lab", ENCODER, DIMENSION, MapSettings(keep="none", learning=SILENT))
    visit(lab, "a", walk(), posed=True)
    visit(lab, "b", walk()[5:], seed=2)
    return lab


@pytest.fixture
def lab(runtime: Runtime) -> Map:
    return two_traverses(runtime)


def submitted(runtime: Runtime, sequence: str = "b", **options: Any) -> Job:
    arguments = {"sequence": sequence, "with": None, "poses": True, "dry_run": False} | options
    return runtime.jobs.submit(alignment.KIND, "lab", arguments=arguments)


def result(runtime: Runtime, sequence: str = "b", **options: Any) -> dict[str, Any]:
    done = end_of(runtime, submitted(runtime, sequence, **options))
    assert done.state == "succeeded", done.problem
    assert done.result is not None
    return dict(done.result)


def at(map_: Map) -> dict[str, tuple[int, int]]:
    """Track and station of each place."""
    where = map_.snapshot().whereabouts
    return {place.id: (int(where.track[place.row]), int(where.station[place.row])) for place in map_.transfer.outline()}


def state(runtime: Runtime) -> Any:
    """Everything that the map stores."""
    return at(runtime.engine.maps.get("lab")), state_of(runtime.engine, "lab")


def test_frames_of_two_traverses_become_the_same_places(runtime: Runtime, lab: Map) -> None:
    found = result(runtime)
    (one,) = found["traverses"]
    assert (found["frames"], found["paired"], found["compared"]) == (35, 35, 40 * 35)
    assert (one["sequence"], one["paired"], one["stretch_count"]) == ("a", 35, 1)
    (stretch,) = one["stretches"]
    assert [stretch[name] for name in ("first", "last", "with_first", "with_last")] == ["b0", "b34", "a5", "a39"]
    there = at(lab)
    assert all(there[f"b{number}"] == there[f"a{number + 5}"] for number in range(35))
    assert one["poses"] == {"received": 35, "given": 0} and found["poses_handed_over"] == 35
    assert lab.place("b3").pose == Pose(x=80, y=0) and lab.place("b3").pose_of == "a8"
    assert lab.place("a8").pose_of is None
    assert runtime.engine.maps.verify("lab").ok


def test_what_was_stored_is_read_again(tmp_path: Path) -> None:
    with runtime_at(tmp_path) as runtime:
        two_traverses(runtime)
        result(runtime)
        stored = state(runtime)
    with runtime_at(tmp_path) as runtime:
        assert state(runtime) == stored


def test_an_alignment_that_is_repeated_changes_nothing(runtime: Runtime, lab: Map) -> None:
    first = result(runtime)
    stored = state(runtime)
    again = result(runtime)
    assert again["stations_changed"] == 0 and again["traverses"] == first["traverses"]
    assert state(runtime) == stored
    assert result(runtime, "a")["paired"] == 35, "from the other side it is the same"
    assert state(runtime) == stored


def test_a_dry_run_stores_nothing(runtime: Runtime, lab: Map) -> None:
    before = state(runtime)
    found = result(runtime, dry_run=True)
    assert found["paired"] == 35 and found["poses_handed_over"] == 35 and not found["stored"]
    assert state(runtime) == before
    assert result(runtime)["traverses"] == found["traverses"]


def test_poses_are_only_handed_over_when_wanted_and_taken_back(runtime: Runtime, lab: Map) -> None:
    before = at(lab), [lab.place(f"b{number}").pose for number in range(35)]
    assert result(runtime, poses=False)["poses_handed_over"] == 0
    assert [lab.place(f"b{number}").pose for number in range(35)] == before[1]
    result(runtime)
    lab.patch("b3", {"pose": {"x": 1.0}})
    assert lab.place("b3").pose_of is None, "an operator's pose is the place's own"
    nothing: dict[str, Any] = {"with": []}
    undone = result(runtime, **nothing)
    assert undone["poses_taken_back"] == 34 and undone["stations_changed"] == 35
    assert lab.place("b3").pose == Pose(x=1, y=0) and lab.place("b4").pose is None
    assert at(lab) == before[0]
    assert lab.place("a8").pose == Pose(x=80, y=0)


def test_poses_go_either_way(runtime: Runtime, lab: Map) -> None:
    """The older traverse gets poses from the newer one, and gives them back when the newer one is forgotten."""
    lab.forget_sequence("a")
    visit(lab, "c", walk(), posed=True, seed=3)
    (one,) = result(runtime, "c")["traverses"]
    assert one["poses"] == {"received": 0, "given": 35}
    assert lab.place("b3").pose_of == "c8"
    undone: dict[str, Any] = {"with": []}
    assert result(runtime, "c", **undone)["poses_taken_back"] == 35
    assert lab.place("b3").pose is None


@pytest.mark.parametrize("order", ["bc", "cb"])
@pytest.mark.parametrize("each", [True, False])
def test_a_third_traverse_aligns_with_either(runtime: Runtime, lab: Map, order: str, each: bool) -> None:
    visit(lab, "c", walk()[10:], seed=3)
    for name in order if each else order[-1]:
        found = result(runtime, name)
        assert [one["sequence"] for one in found["traverses"]] == [one for one in "abc" if one != name]
        assert all(one["paired"] >= 30 for one in found["traverses"])
    there = at(lab)
    assert all(there[f"a{n}"] == there[f"b{n - 5}"] == there[f"c{n - 10}"] for n in range(10, 40))


def test_a_traverse_with_a_few_frames_of_a_long_way(runtime: Runtime, lab: Map) -> None:
    """More than three frames of the other traverse go by from one of its frames to the next."""
    way = walk(seed=5, count=20)
    visit(lab, "dense", np.repeat(way, 5, axis=0), seed=3)
    visit(lab, "sparse", way, seed=4)
    only: dict[str, Any] = {"with": ["dense"]}
    assert result(runtime, "sparse", **only)["paired"] >= 18
    there = at(lab)
    assert sum(there[f"sparse{n}"] in [there[f"dense{5 * n + k}"] for k in range(5)] for n in range(20)) >= 18


def test_traverses_that_share_nothing(runtime: Runtime, lab: Map) -> None:
    visit(lab, "elsewhere", walk(seed=9), seed=3)
    before = state(runtime)
    found = result(runtime, "elsewhere")
    assert [(one["sequence"], one["paired"], one["stretches"]) for one in found["traverses"]] == [
        ("a", 0, []),
        ("b", 0, []),
    ]
    assert found["stations_changed"] == 0
    assert state(runtime) == before


def test_the_first_traverse_of_a_map_and_short_ones(runtime: Runtime, lab: Map) -> None:
    lab.forget_sequence("b")
    assert result(runtime, "a")["traverses"] == []
    visit(lab, "short", walk()[:9], seed=3)
    assert result(runtime, "a")["traverses"] == [], "it is left out"
    for options in ({"sequence": "short"}, {"sequence": "a", "with": ["short"]}):
        failed = end_of(runtime, submitted(runtime, **options))
        assert failed.problem is not None and failed.problem["type"].endswith("too-few-frames")


def test_what_was_found_before_gives_way(runtime: Runtime, lab: Map) -> None:
    """The frames of a traverse were replaced by those of another part of the way."""
    result(runtime)
    lab.forget_sequence("b")
    visit(lab, "b", walk()[:30], seed=4)
    assert all(lab.place(f"b{number}").pose is None for number in range(30))
    result(runtime)
    there = at(lab)
    assert all(there[f"b{number}"] == there[f"a{number}"] for number in range(30))


def test_a_replaced_frame_shows_its_old_place_no_longer(runtime: Runtime, lab: Map) -> None:
    result(runtime)
    kept = lab.place("b3")
    other = Enrolment("b3", PlaceFields(sequence="b"), walk(seed=7)[0], 5, b"another".ljust(32))
    lab.enrol([other])
    assert at(lab)["b3"] == (at(lab)["b0"][0] + 1, 3) and lab.place("b3").pose is None
    assert kept.pose_of == "a8" and lab.place("b3").pose_of is None


def test_of_a_map_that_changes_meanwhile_only_what_is_true_is_stored(
    runtime: Runtime, lab: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    change = alignment._change
    other = Enrolment("b7", PlaceFields(sequence="b"), walk(seed=7)[0], 5, b"another".ljust(32))

    def overtaken(*arguments: Any) -> Any:
        lab.forget("b3")
        lab.forget("a9")
        lab.enrol([other])
        lab.patch("b8", {"sequence": "c"})
        return change(*arguments)

    monkeypatch.setattr(alignment, "_change", overtaken)
    result(runtime)
    there = at(lab)
    assert all(there[f"b{n}"] == there[f"a{n + 5}"] for n in range(35) if n not in (3, 4, 7, 8))
    for name in ("b4", "b7", "b8"):
        assert there[name][0] != there["a0"][0] and lab.place(name).pose is None


@pytest.mark.parametrize("when", ["before the commit", "after the commit"])
def test_a_kill_around_the_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str) -> None:
    with runtime_at(tmp_path) as runtime:
        two_traverses(runtime)
        before = state(runtime)
    store = Counterparts.store

    def broken_off(self: Counterparts, change: Any) -> None:
        if when == "after the commit":
            store(self, change)
        runtime.jobs.stop_soon()
        raise JobInterrupted

    with runtime_at(tmp_path) as runtime, monkeypatch.context() as broken:
        broken.setattr(Counterparts, "store", broken_off)
        job = submitted(runtime)
        wait_until(lambda: runtime.jobs.stopping)
    with runtime_at(tmp_path) as runtime:
        done = end_of(runtime, job)
        assert (done.state, done.attempt) == ("succeeded", 2)
        lab = runtime.engine.maps.get("lab")
        assert at(lab) != before[0] and lab.place("b0").pose_of == "a5"
        stored = state(runtime)
        result(runtime)
        assert state(runtime) == stored


def test_a_cancelled_alignment_leaves_nothing(runtime: Runtime, lab: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    before = state(runtime)

    def cancelled(*_: Any) -> None:
        raise JobCancelled

    monkeypatch.setattr(alignment, "yield_to_requests", cancelled)
    assert end_of(runtime, submitted(runtime)).state == "cancelled"
    assert state(runtime) == before


@pytest.mark.thorough
def test_aligning_over_http(server: Server) -> None:
    server.create_map("aligned", encoder=COARSE)
    enrol_frames(server, "aligned", [encoded(scene(n)) for n in range(14)], "m", sequence="monday")
    again = [encoded(seen_again(scene(n), n)) for n in range(2, 14)]
    for n, frame in enumerate(again):
        assert server.enrol("aligned", f"t{n}", frame, sequence="tuesday").status_code == 201
    done = finished(server, asked(server, "aligned", "align", sequence="tuesday", **{"with": ["monday"]}))
    assert done["state"] == "succeeded", done
    (one,) = done["result"]["traverses"]
    assert one["paired"] >= 10 and one["poses"]["received"] == one["paired"]
    there = places(server, "aligned")
    assert there["t4"]["pose_of"] == "m6" and there["t4"]["pose"] == there["m6"]["pose"]
    assert there["m6"]["pose_of"] is None
    about = server.client.get("/v1/maps/aligned/similarity?query=tuesday&reference=monday").json()
    assert about["aligned"] and about["truth"] is None, "an alignment does not prove itself"


@pytest.mark.thorough
def test_enrolling_with_alignment(server: Server) -> None:
    server.create_map("joined", encoder=COARSE)
    enrol_frames(server, "joined", [encoded(scene(n)) for n in range(14)], "m", sequence="monday")
    files = {f"f{n}": (f"f{n}", encoded(seen_again(scene(n), n)), "image/jpeg") for n in range(14)}
    listed = [{"id": f"t{n}", "file": f"f{n}", "sequence": "tuesday"} for n in range(14)]
    listed += [{"id": "w0", "file": "f0", "sequence": "wednesday"}]
    form: dict[str, Any] = {"data": {"places": json.dumps(listed)}, "files": files}
    address = "/v1/maps/joined/places"
    assert_problem(server.client.post(f"{address}?align=true", **form), 422, "invalid-request")
    done = finished(server, server.client.post(f"{address}?background=true&align=true", **form).json())
    assert done["state"] == "succeeded", done
    tuesday, wednesday = done["result"]["aligned"]
    assert tuesday["sequence"] == "tuesday" and tuesday["paired"] >= 12
    assert wednesday["problem"]["type"].endswith("too-few-frames")
    assert places(server, "joined")["t4"]["pose_of"] == "m4"

    order = {"method": "sequence", "sequence": "tuesday", "target": {"rule": "precision", "value": 0.7}}
    handed = server.client.post("/v1/maps/joined/calibrate", json=order | {"dry_run": True}).json()
    assert any("an alignment alone" in warning for warning in handed["warnings"])
    again = finished(server, asked(server, "joined", "align", sequence="tuesday", poses=False))
    assert again["result"]["poses_taken_back"] == tuesday["paired"]
    calibrated = server.client.post("/v1/maps/joined/calibrate", json=order)
    assert calibrated.status_code == 200, calibrated.text
    assert calibrated.json()["measurement"]["known"] == tuesday["paired"], "counterparts stand in for poses"
    assert calibrated.json()["measurement"] == handed["measurement"], "poses handed over add nothing to them"


def test_what_cannot_be_aligned(server: Server) -> None:
    server.create_map("few", encoder=COARSE)
    enrol_frames(server, "few", [encoded(scene(n)) for n in range(3)], "m", sequence="monday")
    post = server.client.post
    for body, status, kind in (
        ({"sequence": "none"}, 404, "unknown-sequence"),
        ({"sequence": "monday"}, 422, "too-few-frames"),
        ({"sequence": "monday", "with": ["monday"]}, 422, "invalid-request"),
        ({"sequence": "monday", "with": "tuesday"}, 422, "invalid-request"),
        ({"sequence": "monday", "odd": 1}, 422, "invalid-request"),
        ({}, 422, "invalid-request"),
    ):
        assert_problem(post("/v1/maps/few/align", json=body), status, kind)
    assert_problem(post("/v1/maps/none/align", json={"sequence": "monday"}), 404, "unknown-map")
