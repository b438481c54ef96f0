"""Pruning over HTTP, and a pruning that is interrupted: the places that it chose are removed once, and no others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from core.ledger.maps.transfer import Transfer
from core.maps import MapSettings
from service.engine.engine import Engine
from service.jobs.context import JobInterrupted
from service.upkeep import pruning
from tests.service.encoders import COARSE
from tests.service.engines import ENCODER, end_of, enrolments, runtime_at
from tests.service.map_jobs import asked, enrol_frames, finished, places, wait_until, walk_frames
from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem


@pytest.mark.thorough
def test_pruning_first_reports_and_then_does_what_it_reported(server: Server) -> None:
    server.create_map("dense", encoder=COARSE, same_place_radius=2.5)
    enrol_frames(server, "dense", walk_frames(32), sequence="monday")
    before = places(server, "dense")
    report = finished(server, asked(server, "dense", "prune", max_recall_loss=0.1))["result"]
    assert places(server, "dense") == before, "a dry run changes nothing"
    assert 0 < report["removed"] < 32 and report["recall_loss"] <= 0.1
    assert report["measured_on"] == "leave-one-out" and report["queries"] == 32
    assert report["recall_before"]["low"] <= report["recall_before"]["value"] <= report["recall_before"]["high"]
    removed = [one["removed"] for one in report["tried"]]
    assert removed[0] <= report["removed"] <= removed[-1]
    done = finished(server, asked(server, "dense", "prune", max_recall_loss=0.1, dry_run=False))
    assert done["state"] == "succeeded"
    after = places(server, "dense")
    assert {name: done["result"][name] for name in report} == report
    assert len(after) == done["result"]["places_after"] == 32 - report["removed"]
    gone = set(before) - set(after)
    assert gone == set(report["named"])
    for name in gone:  # the place itself is still found: by its neighbour
        x = before[name]["pose"]["x"]
        assert any(abs(place["pose"]["x"] - x) <= 2.5 for place in after.values())
    assert server.client.post("/v1/maps/dense/verify").json()["ok"]


@pytest.mark.thorough
def test_pruning_measured_on_another_traverse(server: Server) -> None:
    server.create_map("second", encoder=COARSE, same_place_radius=2.5)
    enrol_frames(server, "second", walk_frames(16), sequence="monday")
    again = [encoded(seen_again(scene(n // 4), n)) for n in range(0, 16, 2)]
    for n, frame in enumerate(again):
        assert server.enrol("second", f"q{n}", frame, x=2 * n, y=0.1, sequence="tuesday").status_code == 201
    job = asked(server, "second", "prune", queries="tuesday", similarity=0.1, dry_run=False)
    done = finished(server, job)["result"]
    assert done["measured_on"] == "tuesday" and done["queries"] == 8 and done["removed"] > 0
    left = places(server, "second")
    assert {name for name in left if name.startswith("q")} == {f"q{n}" for n in range(8)}
    assert len(left) == 24 - done["removed"]


def test_only_places_of_the_given_sequence_are_removed(server: Server) -> None:
    server.create_map("partly", encoder=COARSE, same_place_radius=2.5)
    enrol_frames(server, "partly", walk_frames(12), "a", sequence="monday")
    enrol_frames(server, "partly", [frame + b"\x00" for frame in walk_frames(12)], "b", sequence="tuesday")
    done = finished(server, asked(server, "partly", "prune", sequence="tuesday", similarity=0.1, dry_run=False))
    assert done["result"]["removed"] == 12, "each has its counterpart in the other traverse"
    assert set(places(server, "partly")) == {f"a{n}" for n in range(12)}


@pytest.mark.thorough
def test_of_a_stop_further_looks_go_and_the_first_stays(server: Server) -> None:
    server.create_map("stood", encoder=COARSE, same_place_frames=1)
    way = walk_frames(24)
    frames = [*way[:12], *(way[12] + bytes(look) for look in range(40)), *way[13:]]
    for number, frame in enumerate(frames):
        assert server.enrol("stood", f"p{number}", frame, sequence="monday").status_code == 201
    health = server.client.get("/v1/maps/stood/health").json()
    (stop,) = health["stops"]
    assert health["complete"] and health["aliasing"]["of"] == len(frames) - stop["frames"] + 1
    dry = finished(server, asked(server, "stood", "prune", max_recall_loss=0))["result"]
    assert dry["queries"] <= 24, "the looks do not outvote the other places"
    assert dry["recall_before"]["value"] == dry["recall_after"]["value"]
    assert dry["tried"][0]["removed"] == stop["frames"] - 1, "the further looks go first, whatever else looks alike"
    assert dry["removed"] >= stop["frames"] - 1
    bold = finished(server, asked(server, "stood", "prune", similarity=-1.0, dry_run=False))["result"]
    left = places(server, "stood")
    assert stop["place"] in left and bold["removed"] >= stop["frames"] - 1
    assert not {f"p{n}" for n in range(13, 52)} & set(left)


@pytest.mark.thorough
def test_pruning_what_cannot_be_pruned(server: Server) -> None:
    server.create_map("sparse", encoder=COARSE, same_place_radius=0.5)
    enrol_frames(server, "sparse", [jpeg(n) for n in range(3)], sequence="monday")
    failed = finished(server, asked(server, "sparse", "prune"))
    assert failed["state"] == "failed"
    assert failed["problem"]["type"] == "urn:placerec:problem:nothing-to-measure"
    post = server.client.post
    assert_problem(post("/v1/maps/sparse/prune", json={"sequence": "none"}), 404, "unknown-sequence")
    assert_problem(post("/v1/maps/sparse/prune", json={"max_recall_loss": 2}), 422, "invalid-request")
    both = {"sequence": "monday", "queries": "monday"}
    assert_problem(post("/v1/maps/sparse/prune", json=both), 422, "invalid-request")
    assert_problem(post("/v1/maps/none/prune", json={}), 404, "unknown-map")
    assert_problem(post("/v1/maps/sparse/prune", json={"odd": 1}), 422, "invalid-request")


GOING = ("l1", "l3", "l5")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A map of eight places and a made-up plan to remove three, since nothing can be encoded here."""
    with runtime_at(tmp_path) as runtime:
        runtime.engine.maps.create("lab", ENCODER, 8, MapSettings(keep="none")).enrol(enrolments(0, 8, "l", "monday"))
    planned = 0

    def plan(engine: Engine, _: Any) -> tuple[dict[str, Any], dict[str, str]]:
        nonlocal planned
        planned += 1
        assert planned == 1, "a second plan would prune the pruned map again"
        there = engine.maps.get("lab").transfer.outline()
        return {"removed": 3}, {place.id: place.digest.hex() for place in there if place.id in GOING}

    monkeypatch.setattr(pruning, "_plan", plan)
    return tmp_path


@pytest.mark.parametrize("when", ["before it goes", "after it went"])
def test_a_kill_around_the_commit(folder: Path, monkeypatch: pytest.MonkeyPatch, when: str) -> None:
    forget = Transfer.forget

    def broken_off(self: Transfer, frames: dict[str, bytes]) -> int:
        if when == "after it went":
            forget(self, frames)
        runtime.jobs.stop_soon()
        raise JobInterrupted

    with runtime_at(folder) as runtime, monkeypatch.context() as broken:
        broken.setattr(Transfer, "forget", broken_off)
        job = runtime.jobs.submit(pruning.KIND, "lab", arguments={"dry_run": False})
        wait_until(lambda: runtime.jobs.stopping)
    with runtime_at(folder) as runtime:
        done = end_of(runtime, job)
        assert (done.state, done.attempt, done.result) == ("succeeded", 2, {"removed": 3, "places_after": 5})
        left = [place.id for place in runtime.engine.maps.get("lab").transfer.outline()]
        assert left == ["l0", "l2", "l4", "l6", "l7"]


def test_a_place_that_has_another_frame_by_now_stays(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with runtime_at(folder) as runtime:
        lab = runtime.engine.maps.get("lab")
        plan = pruning._plan

        def and_then(*arguments: Any) -> Any:
            found = plan(*arguments)
            (other,) = enrolments(100, 1, "l", "monday")
            lab.enrol([type(other)("l3", other.fields, other.descriptor, 5, other.digest)])
            return found

        monkeypatch.setattr(pruning, "_plan", and_then)
        done = end_of(runtime, runtime.jobs.submit(pruning.KIND, "lab", arguments={"dry_run": False}))
        assert done.result == {"removed": 3, "places_after": 6}
        assert "l3" in [place.id for place in lab.transfer.outline()]
