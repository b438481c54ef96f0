"""The health report of a map, over HTTP."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from service.queries.count_tables import FILE
from service.queries.statistics import map_key
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.engines import runtime_at
from tests.service.map_jobs import asked, enrol_frames, enrol_many, finished, wait_until, walk_frames
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem


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
        server.create_map("twice-made", encoder=COARSE)
        enrol_frames(server, "twice-made", [jpeg(n) for n in range(2)])
        assert server.client.get("/v1/maps/twice-made/health").json()["answers"]["queries"] == 0
        server.query("twice-made", jpeg(1))
        assert server.client.get("/v1/maps/twice-made/health").json()["answers"]["queries"] == 1
        assert server.client.delete("/v1/maps/twice-made").status_code == 204


@pytest.mark.thorough
def test_gaps_and_stretches_to_record_again(server: Server) -> None:
    server.create_map("gapped", encoder=COARSE, same_place_radius=1.2)
    positions = [0, 1, 2, 3, 4, 5, 25, 26, 27, 28, 29]  # metres; nobody filmed from 5 to 25
    frames = walk_frames(len(positions))
    for n, x in enumerate(positions):
        stamp = f"2026-11-20T10:00:{n:02}Z"
        assert (
            server.enrol("gapped", f"p{n}", frames[n], x=x, y=0, sequence="monday", timestamp=stamp).status_code == 201
        )
    report = server.client.get("/v1/maps/gapped/health").json()
    (gap,) = [gap for gap in report["gaps"] if gap["measure"] == "distance"]
    assert (gap["sequence"], gap["before"], gap["after"]) == ("monday", "p5", "p6")
    assert (gap["value"], gap["median"], gap["severity"]) == (20.0, 1.0, 20.0)
    plan = server.client.get("/v1/maps/gapped/plan").json()
    assert plan["gaps"] == [{"before": "p5", "after": "p6", "metres": 20.0}], "by one rule"
    assert plan["gap_count"] == report["gap_counts"]["distance"] == 1
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
    pairs = [{alias["place"], alias["other"]} for alias in aliases]
    assert pairs.count({"at0", "at40"}) == 1, "each pair is listed once"
    assert all(alias["own"] < alias["score"] for alias in aliases)


def test_a_second_drive_is_no_look_alike_but_to_be_aligned(server: Server) -> None:
    server.create_map("driven-twice", encoder=COARSE)
    frames = [encoded(scene(n)) for n in range(14)]
    again = [encoded(seen_again(scene(n), n)) for n in range(14)]
    enrol_frames(server, "driven-twice", frames, "m", sequence="monday")
    enrol_frames(server, "driven-twice", again, "t", sequence="tuesday", x=None, y=None)
    path = "/v1/maps/driven-twice"
    report = server.client.get(f"{path}/health").json()
    (route,) = report["shared_routes"]
    assert (route["sequence"], route["other"]) == ("tuesday", "monday") and route["frames"] >= 20
    assert report["aliasing"]["alias_count"] <= 2 and not any(
        "aliased" in stretch["reasons"] for stretch in report["retraverse"]
    )
    assert finished(server, asked(server, "driven-twice", "align", sequence="tuesday"))["state"] == "succeeded"
    assert server.client.get(f"{path}/health").json()["shared_routes"] == []


def test_one_query_is_no_advice(server: Server) -> None:
    server.create_map("asked-once", encoder=COARSE)
    enrol_frames(server, "asked-once", [jpeg(n) for n in range(12)], sequence="monday")
    server.query("asked-once", jpeg(0))
    report = server.client.get("/v1/maps/asked-once/health").json()
    silent = report["never_matched"]
    assert (silent["count"], silent["queries"], silent["wanted"], silent["enough"]) == (11, 1, 36, False)
    assert not any("never-matched" in stretch["reasons"] for stretch in report["retraverse"])
    for _ in range(35):
        server.query("asked-once", jpeg(0))
    report = server.client.get("/v1/maps/asked-once/health?limit=3").json()
    assert report["never_matched"]["enough"] and len(report["never_matched"]["places"]) == 3
    assert any("never-matched" in stretch["reasons"] for stretch in report["retraverse"])


@pytest.mark.parametrize("query", ["seconds=0", "seconds=99", "limit=0", "limit=1001", "more=1", "seconds=nan"])
def test_health_refuses_invalid_parameters(server: Server, traverse: str, query: str) -> None:
    assert_problem(server.client.get(f"/v1/maps/{traverse}/health?{query}"), 422, "invalid-request")
    assert_problem(server.client.get("/v1/maps/none/health"), 404, "unknown-map")


@pytest.mark.thorough
def test_counts_survive_a_restart(tmp_path: Path) -> None:
    install_coarse_encoder(tmp_path / "models")
    server = Server(tmp_path, {"statistics_seconds": 0.2}).wait()
    enrol_many(server, "lab", 4)
    server.query("lab", jpeg(1))
    with closing(sqlite3.connect(f"file:{server.data_dir / FILE}?mode=ro", uri=True)) as written:
        wait_until(lambda: written.execute("SELECT count(*) FROM week_counts").fetchone() == (1,))
    server.kill()
    server = Server(tmp_path).wait()
    assert server.client.get("/v1/maps/lab/health").json()["answers"]["queries"] == 1
    server.query("lab", jpeg(1))
    assert server.stop() == 0
    with runtime_at(tmp_path) as runtime:
        counted = runtime.statistics.read(map_key(runtime.engine.maps.get("lab")))
        assert sum(week.queries for week in counted.weeks) == 2
