"""Health, pruning and merging over HTTP."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from core.storage import MapSettings
from service.queries.statistics import map_key
from tests.service.encoders import COARSE, TWO_STAGES, install_coarse_encoder
from tests.service.engines import enrolments, runtime_at
from tests.service.map_jobs import asked, enrol_frames, enrol_many, finished, places, reaching, wait_until
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem, typed


def between(seed: int, share: float) -> bytes:
    """A frame on the way from one scene to the next."""
    mixed = (1 - share) * scene(seed).astype(np.float32) + share * scene(seed + 1).astype(np.float32)
    return encoded(np.asarray(mixed, np.uint8))


def dense(count: int, per_scene: int = 4) -> list[bytes]:
    return [between(n // per_scene, (n % per_scene) / per_scene / 3) for n in range(count)]


# Health


def test_health_of_a_map_that_was_never_queried(server: Server) -> None:
    server.create_map("fresh", encoder=COARSE)
    report = server.client.get("/v1/maps/fresh/health").json()
    assert report["places"] == 0 and report["complete"] and report["never_matched"] is None
    assert report["answers"]["queries"] == 0 and report["answers"]["since"] is None
    enrol_frames(server, "fresh", [jpeg(n) for n in range(8)], sequence="monday")
    report = server.client.get("/v1/maps/fresh/health").json()
    assert report["places"] == report["aliasing"]["of"] == report["aliasing"]["examined"] == 8
    assert report["gaps"] == [] and report["never_matched"] is None


def test_health_of_a_single_place(server: Server) -> None:
    server.create_map("single", encoder=COARSE)
    enrol_frames(server, "single", [jpeg(1)])
    response = server.client.get("/v1/maps/single/health")
    assert response.status_code == 200, response.text
    aliasing = response.json()["aliasing"]
    assert (aliasing["examined"], aliasing["aliases"], aliasing["hubs"]) == (1, [], [])


def test_health_counts_what_was_answered(server: Server) -> None:
    server.create_map("counted", encoder=COARSE)
    enrol_frames(server, "counted", [jpeg(n) for n in range(6)], sequence="monday")
    verdicts = []
    for seed in (0, 0, 1, 2, 40):
        answer = server.query("counted", encoded(seen_again(scene(seed), 1)))
        verdicts.append(answer["verdict"])
        if seed < 6:
            assert answer["matches"][0]["place"]["id"] == f"p{seed}"
    stranger = answer["matches"][0]["place"]["id"]
    server.query("counted", encoded(blank()))
    report = server.client.get("/v1/maps/counted/health").json()
    answers = report["answers"]
    assert answers["queries"] == 6 and answers["unknown"] == verdicts.count("unknown") + 1
    (week,) = answers["weeks"]
    assert week["blank"] == 1 and sum(week["scores"]) == 5 and answers["score_trend"] is None
    matched = {"p0", "p1", "p2", stranger}
    assert report["never_matched"]["places"] == [f"p{n}" for n in range(6) if f"p{n}" not in matched]
    assert report["never_matched"]["by_chance"] == pytest.approx(6 * np.exp(-5 / 6))


def test_a_new_map_of_the_same_name_begins_with_nothing(server: Server) -> None:
    for _ in range(2):
        server.create_map("again", encoder=COARSE)
        enrol_frames(server, "again", [jpeg(n) for n in range(2)])
        assert server.client.get("/v1/maps/again/health").json()["answers"]["queries"] == 0
        server.query("again", jpeg(1))
        assert server.client.get("/v1/maps/again/health").json()["answers"]["queries"] == 1
        assert server.client.delete("/v1/maps/again").status_code == 204


def test_gaps_and_stretches_to_record_again(server: Server) -> None:
    server.create_map("gapped", encoder=COARSE, same_place_radius=1.2)
    positions = [0, 1, 2, 3, 4, 5, 25, 26, 27, 28, 29]  # metres; nobody filmed from 5 to 25
    frames = dense(len(positions))
    for n, x in enumerate(positions):
        stamp = f"2026-11-20T10:00:{n:02}Z"
        assert (
            server.enrol("gapped", f"p{n}", frames[n], x=x, y=0, sequence="monday", timestamp=stamp).status_code == 201
        )
    report = server.client.get("/v1/maps/gapped/health").json()
    (gap,) = [gap for gap in report["gaps"] if gap["measure"] == "distance"]
    assert (gap["sequence"], gap["before"], gap["after"]) == ("monday", "p5", "p6")
    assert (gap["value"], gap["median"], gap["severity"]) == (20.0, 1.0, 20.0)
    first = report["retraverse"][0]
    assert "distance-gap" in first["reasons"] and first["sequence"] == "monday"
    order = [f"p{n}" for n in range(11)]
    assert order.index(first["first"]) <= 5 and order.index(first["last"]) >= 6
    assert server.client.get("/v1/maps/gapped/health?limit=1").json()["gap_count"] == report["gap_count"]


def test_places_that_look_alike_are_listed(server: Server) -> None:
    """Two places far apart look the same, while frames of the same place look different."""
    server.create_map("twins", encoder=COARSE, same_place_radius=1.2)
    frames = {0: 1, 1: 2, 40: 1, 41: 3}
    for x, seed in frames.items():
        frame = encoded(seen_again(scene(seed), x))
        assert server.enrol("twins", f"at{x}", frame, x=x, y=0, sequence="monday").status_code == 201
    aliases = server.client.get("/v1/maps/twins/health").json()["aliasing"]["aliases"]
    pairs = {(alias["place"], alias["other"]) for alias in aliases}
    assert {("at0", "at40"), ("at40", "at0")} <= pairs
    assert all(alias["own"] < alias["score"] for alias in aliases)


@pytest.mark.parametrize("query", ["seconds=0", "seconds=99", "limit=0", "limit=1001", "more=1", "seconds=nan"])
def test_health_refuses_invalid_parameters(server: Server, traverse: str, query: str) -> None:
    assert_problem(server.client.get(f"/v1/maps/{traverse}/health?{query}"), 422, "invalid-request")
    assert_problem(server.client.get("/v1/maps/none/health"), 404, "unknown-map")


# Pruning


def test_pruning_first_reports_and_then_does_what_it_reported(server: Server) -> None:
    server.create_map("dense", encoder=COARSE, same_place_radius=2.5)
    enrol_frames(server, "dense", dense(32), sequence="monday")
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


def test_pruning_measured_on_another_traverse(server: Server) -> None:
    server.create_map("second", encoder=COARSE, same_place_radius=2.5)
    enrol_frames(server, "second", dense(16), sequence="monday")
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
    enrol_frames(server, "partly", dense(12), "a", sequence="monday")
    enrol_frames(server, "partly", [frame + b"\x00" for frame in dense(12)], "b", sequence="tuesday")
    done = finished(server, asked(server, "partly", "prune", sequence="tuesday", similarity=0.1, dry_run=False))
    assert done["result"]["removed"] == 12, "each has its counterpart in the other traverse"
    assert set(places(server, "partly")) == {f"a{n}" for n in range(12)}


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


# Merging


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
        mask = {"mask": {"polygons": [polygon]}}
        assert server.client.put(f"/v1/maps/{name}/cameras/front", json=mask).status_code == 201
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
    masks = [
        server.client.get(f"/v1/maps/{m}/cameras/{c}").json()["mask"]
        for m, c in (("ours", "t.front"), ("theirs", "front"))
    ]
    assert masks[0] == masks[1]


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


# Kills


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    install_coarse_encoder(tmp_path / "models")
    return tmp_path


MANY = 640


@pytest.mark.timeout(300)  # the service is started several times
def test_a_kill_in_the_middle_of_a_merge(folder: Path) -> None:
    with runtime_at(folder) as runtime:
        identity = runtime.engine.resolve(COARSE)
        encoder = next(one for one in runtime.engine.catalogue.describe() if one.identity == identity)
        settings = MapSettings(keep="thumbnail")
        for name, first, count, sequence in (("lab", 1, 64, "monday"), ("hall", 1001, MANY, "tuesday")):
            map_ = runtime.engine.atlas.create(name, identity, encoder.dimension, settings, encoder.local_shape)
            map_.enrol(enrolments(first, count, name[0], sequence, encoder.dimension))
    server = Server(folder).wait()
    answered = 0

    def ask() -> None:
        """A robot that queries without a pause: the merge gives way to each query, and so takes long."""
        nonlocal answered
        with suppress(httpx.TransportError), httpx.Client(base_url=server.client.base_url, timeout=30) as client:
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
        robot.join(30)
    server = Server(folder).wait()
    done = finished(server, job)
    assert (done["state"], done["attempt"]) == ("succeeded", 2), done
    here, there = places(server, "lab"), places(server, "hall")
    assert len(here) == 64 + MANY == done["result"]["places"]
    assert {name: here[name] for name in there} == there
    assert server.client.post("/v1/maps/lab/verify").json()["ok"]
    assert server.stop() == 0


def test_counts_survive_a_restart(folder: Path) -> None:
    server = Server(folder, {"statistics_seconds": 0.2}).wait()
    enrol_many(server, "lab", 4)
    server.query("lab", jpeg(1))
    time.sleep(1.0)
    server.kill()
    server = Server(folder).wait()
    assert server.client.get("/v1/maps/lab/health").json()["answers"]["queries"] == 1
    server.query("lab", jpeg(1))
    assert server.stop() == 0
    with runtime_at(folder) as runtime:
        counted = runtime.statistics.read(map_key(runtime.engine.atlas.get("lab")))
        assert sum(week.queries for week in counted.weeks) == 2
