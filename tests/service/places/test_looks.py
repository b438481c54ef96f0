"""Looks over HTTP: pictures of a place under other conditions, by which it is found as the one place that it is."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi.testclient import TestClient

from core.frames.images import decode
from core.judgement.trials import StagedTrials, Trial, gathered
from core.judgement.verdict import Judgement
from core.learning import Witness
from core.maps import Enrolment
from core.maps.records import MOST_LOOKS
from core.places import PlaceFields, look_address
from core.store import Map
from service.app.application import create_app
from service.places import looks
from service.places.enrolment import enrol_look
from service.queries.histories.run_trials import RunTrials
from service.queries.statistics import map_key
from service.settings import Settings
from tests.service.map_jobs import asked, finished
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem

CORRIDOR = Path(__file__).parents[4] / "shared/datasets/eval/corridor"


def add_look(server: Server, map_id: str, place: str, picture: bytes, **fields: Any) -> httpx.Response:
    return server.client.post(
        f"/v1/maps/{map_id}/places/{place}/looks",
        params=fields,
        content=picture,
        headers={"Content-Type": "image/jpeg"},
    )


def done(server: Server, map_id: str, what: str, **body: Any) -> dict[str, Any]:
    """The result of a job for a map."""
    job = finished(server, asked(server, map_id, what, **body))
    assert job["state"] == "succeeded", job
    result: dict[str, Any] = job["result"]
    return result


def again(seed: int) -> bytes:
    """What a robot sees of a scene later."""
    return encoded(seen_again(scene(seed), 5))


@pytest.fixture
def hall(server: Server, map_id: str) -> str:
    """A map of six places, with a look of ``p1`` that shows another scene than its first."""
    for number in range(6):
        server.enrol(map_id, f"p{number}", jpeg(number), x=10 * number, y=0, sequence="day", metadata={"n": number})
    assert add_look(server, map_id, "p1", jpeg(71), timestamp="2026-11-20T22:00:00Z").status_code == 201
    return map_id


def test_a_place_is_found_by_any_of_its_looks(server: Server, hall: str) -> None:
    for seed, look in ((1, None), (71, True)):
        answer = server.query(hall, again(seed), k=6)
        assert answer["verdict"] == "recognized" and answer["place"]["id"] == "p1"
        assert answer["place"]["pose"] == {"x": 10.0, "y": 0.0} and answer["place"]["metadata"] == {"n": 1}
        assert ("look" in answer["place"]) == (look is not None)
        assert sorted(match["place"]["id"] for match in answer["matches"]) == [f"p{n}" for n in range(6)]
        assert [match["rank"] for match in answer["matches"]] == [1, 2, 3, 4, 5, 6]
        assert answer["rivals"] == []
    place = server.client.get(f"/v1/maps/{hall}/places/p1").json()
    assert place["looks"] == 1 and answer["place"]["looks"] == 1


@pytest.mark.thorough
@pytest.mark.skipif(not CORRIDOR.is_dir(), reason="the corridor images are not on this machine")
def test_looks_by_night_make_no_frame_by_night_unknown(server: Server) -> None:
    """Not fewer frames by night are recognized rightly in a map of which all places have looks by night."""

    def by_night(path: Path) -> bytes:
        dark = decode(path.read_bytes()).astype(np.float32) * 0.25
        noise = np.random.default_rng(int(path.stem)).normal(0, 4, dark.shape)
        return encoded(np.asarray(np.clip(dark + noise, 0, 255), np.uint8))

    reference, asked = (sorted((CORRIDOR / folder).glob("*.jpg"))[:40] for folder in ("ref", "query"))
    recognized = {}
    for name in ("night-without-looks", "night-with-looks"):
        server.create_map(name)
        for number, path in enumerate(reference):
            assert server.enrol(name, str(number), path.read_bytes(), sequence="day").status_code == 201
            if name == "night-with-looks":
                assert add_look(server, name, str(number), by_night(path)).status_code == 201
        answers = [server.query(name, by_night(path)) for path in asked]
        recognized[name] = sum(
            answer["verdict"] == "recognized" and abs(int(answer["matches"][0]["place"]["id"]) - number) <= 2
            for number, answer in enumerate(answers)
        )
    assert recognized["night-with-looks"] >= recognized["night-without-looks"], recognized


def test_looks_are_one_place_in_every_count(server: Server, hall: str) -> None:
    client = server.client
    assert client.get(f"/v1/maps/{hall}").json()["places"] == 6
    listed = client.get(f"/v1/maps/{hall}/places", params={"limit": 100}).json()["items"]
    assert [place["id"] for place in listed] == [f"p{number}" for number in range(6)]
    (traverse,) = client.get(f"/v1/maps/{hall}/sequences").json()["items"]
    assert traverse["places"] == 6
    plan = client.get(f"/v1/maps/{hall}/plan").json()
    assert plan["ids"] == [f"p{number}" for number in range(6)]


def test_the_name_of_a_look_follows_from_its_frame(server: Server, hall: str) -> None:
    repeated = add_look(server, hall, "p1", jpeg(71), timestamp="2026-11-20T22:00:00Z")
    assert repeated.status_code == 200 and repeated.json()["change"] == "unchanged"
    other = add_look(server, hall, "p2", jpeg(71)).json()
    assert (other["name"], other["place"], other["change"]) == (repeated.json()["name"], "p2", "created")
    assert other["timestamp"] is None and other["run"] is None and other["regions"] > 0


def test_looks_are_listed_seen_and_removed(server: Server, hall: str) -> None:
    client, path = server.client, f"/v1/maps/{hall}/places/p1/looks"
    (look,) = client.get(path).json()["items"]
    assert look["place"] == "p1" and look["timestamp"] == "2026-11-20T22:00:00Z"
    assert client.get(f"/v1/maps/{hall}/looks").json()["items"] == [look]
    assert client.get(f"/v1/maps/{hall}/looks", params={"run": "monday"}).json()["items"] == []
    picture = client.get(f"{path}/{look['name']}/thumbnail")
    assert picture.status_code == 200 and picture.headers["content-type"] == "image/jpeg"
    assert picture.content != client.get(f"/v1/maps/{hall}/places/p1/thumbnail").content
    assert client.delete(f"{path}/{look['name']}").status_code == 204
    assert client.get(path).json()["items"] == []
    assert "looks" not in client.get(f"/v1/maps/{hall}/places/p1").json()
    assert_problem(client.delete(f"{path}/{look['name']}"), 404, "unknown-look")
    assert_problem(client.get(f"{path}/{look['name']}/thumbnail"), 404, "unknown-look")
    answer = server.query(hall, again(71))
    assert answer["verdict"] != "recognized", "the place is found by a look that it has no more"


def test_a_place_takes_its_looks_along(server: Server, hall: str) -> None:
    server.client.patch(f"/v1/maps/{hall}/places/p1", json={"pose": {"x": 77, "y": 1}, "metadata": {"n": None, "m": 2}})
    found = server.query(hall, again(71))["place"]
    assert found["pose"] == {"x": 77.0, "y": 1.0} and found["metadata"] == {"m": 2}
    narrowed = server.query(hall, again(71), where='{"m": 2}')
    assert narrowed["place"]["id"] == "p1"
    assert server.query(hall, again(71), where='{"n": 2}')["verdict"] != "recognized"
    assert server.client.delete(f"/v1/maps/{hall}/places/p1").status_code == 204
    assert server.client.get(f"/v1/maps/{hall}/looks").json()["items"] == []
    assert server.query(hall, again(71))["verdict"] != "recognized"


def test_a_new_frame_of_a_place_leaves_the_looks_that_people_added(server: Server, hall: str) -> None:
    assert server.enrol(hall, "p1", jpeg(90), x=10, y=0, sequence="day").json()["change"] == "replaced"
    assert server.query(hall, again(71))["place"]["id"] == "p1"
    assert server.client.get(f"/v1/maps/{hall}/places/p1").json()["looks"] == 1


def test_a_place_without_a_sequence_has_looks_as_well(server: Server, map_id: str) -> None:
    for number in range(4):
        server.enrol(map_id, f"q{number}", jpeg(number))
    assert add_look(server, map_id, "q0", jpeg(71)).status_code == 201
    answer = server.query(map_id, again(71), k=9)
    assert answer["place"]["id"] == "q0" and answer["rivals"] == []
    assert sorted(match["place"]["id"] for match in answer["matches"]) == ["q0", "q1", "q2", "q3"]


def test_a_session_knows_a_place_by_its_looks(server: Server, hall: str) -> None:
    session = server.client.post(f"/v1/maps/{hall}/sessions", json={}).json()["id"]
    for seed in (0, 71, 2):
        answer = server.client.post(
            f"/v1/maps/{hall}/sessions/{session}/frames", content=again(seed), headers={"Content-Type": "image/jpeg"}
        ).json()
    candidates = [one["place"]["id"] for one in answer["candidates"]]
    assert candidates[0] == "p2" and len(candidates) == len(set(candidates))
    assert answer["frames"] == 3 and not answer["lost"]


def test_what_cannot_be_a_look_is_refused(server: Server, hall: str) -> None:
    assert_problem(add_look(server, hall, "nowhere", jpeg(3)), 404, "unknown-place")
    assert_problem(add_look(server, hall, "p1", jpeg(1)), 409, "repeated-look")
    assert_problem(add_look(server, hall, "p1", encoded(blank())), 422, "no-regions")
    assert_problem(add_look(server, hall, "p1", b"no picture"), 422, "not-an-image")
    assert_problem(add_look(server, hall, "p1", jpeg(3), camera="unheard-of"), 404, "unknown-camera")
    assert_problem(add_look(server, hall, "p1", jpeg(3), x=1), 422, "invalid-request")
    assert_problem(server.client.get(f"/v1/maps/{hall}/places/p1/looks/XYZ/thumbnail"), 422, "invalid-identifier")
    assert_problem(server.client.get(f"/v1/maps/{hall}/places/none/looks"), 404, "unknown-place")
    listed = server.client.get(f"/v1/maps/{hall}/places/p1/looks").json()["items"]
    assert len(listed) == 1, "a refused look left something"


@pytest.mark.thorough
def test_a_look_that_is_removed_in_the_same_moment_is_unknown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def added_and_removed(engine: Any, map_: Map, place_id: str, *rest: Any) -> Any:
        stored = await enrol_look(engine, map_, place_id, *rest)
        map_.forget_look(place_id, stored.name)
        return stored

    monkeypatch.setattr(looks, "enrol_look", added_and_removed)
    with TestClient(create_app(Settings(data_dir=tmp_path), as_owner=True), raise_server_exceptions=False) as client:
        client.post("/v1/maps", json={"id": "hall"})
        sent = {"content": jpeg(0), "headers": {"Content-Type": "image/jpeg"}}
        assert client.put("/v1/maps/hall/places/p", **sent).status_code == 201
        answer = client.post("/v1/maps/hall/places/p/looks", **{**sent, "content": jpeg(71)})
        assert answer.status_code == 404 and answer.json()["type"].endswith("unknown-look"), answer.text
        assert client.get("/v1/maps/hall/looks").json()["items"] == []


def test_learnt_looks_go_by_run_and_by_time(tmp_path: Path) -> None:
    with TestClient(create_app(Settings(data_dir=tmp_path), as_owner=True)) as client:
        client.post("/v1/maps", json={"id": "hall"})
        sent = {"content": jpeg(0), "headers": {"Content-Type": "image/jpeg"}}
        assert client.put("/v1/maps/hall/places/p", **sent).status_code == 201
        assert client.post("/v1/maps/hall/places/p/looks", **{**sent, "content": jpeg(70)}).status_code == 201
        map_ = client.app.state.engine.maps.get("hall")  # type: ignore[attr-defined]
        moments = []
        for number, run in enumerate(("s-1", "s-1", "s-2")):
            digest = bytes([number]) * 32
            vector = np.ones(map_.record.dimension, np.float32)
            local = np.ones(map_.record.local_shape, np.int8)
            name = look_address("p", digest.hex()[:16])
            map_.enrol([Enrolment(name, PlaceFields(), vector, 1, digest, local, run=run)])
            moments.append(client.get("/v1/maps/hall/places/p/looks").json()["items"][-1]["created_at"])
        path, statistics = "/v1/maps/hall/looks", client.app.state.statistics  # type: ignore[attr-defined]
        trials = StagedTrials.of(gathered([Trial(Judgement("unknown", 0.1, 0.02, None, None), True, True, 0)]))
        for run in ("s-1", "s-2"):
            statistics.keep_run_trials(map_key(map_), RunTrials(run, Witness("robot", datetime.now(UTC)), trials))

        def left() -> list[str | None]:
            return [look["run"] for look in client.get(path).json()["items"]]

        assert client.delete(path).status_code == 422 and left() == [None, "s-1", "s-1", "s-2"], "all at once"
        assert client.delete(path, params={"since": "yesterday"}).status_code == 422
        answer = client.delete(path, params={"run": "s-1", "since": moments[1]})
        assert answer.status_code == 200, answer.text
        gone = answer.json()
        assert (gone["looks"], gone["run"], gone["since"], gone["until"]) == (1, "s-1", moments[1], None)
        assert left() == [None, "s-1", "s-2"]
        assert client.delete(path, params={"until": moments[0]}).json()["looks"] == 0
        assert client.delete(path, params={"until": moments[2]}).json()["looks"] == 1
        assert left() == [None, "s-2"]
        assert client.delete(path, params={"since": moments[0]}).json()["looks"] == 1
        assert left() == [None], "what a person added stays"
        assert [one.run for one in statistics.run_trials(map_key(map_))] == ["s-1", "s-2"], "no run went as a whole"
        assert client.delete(path, params={"run": "s-1"}).json()["looks"] == 0
        assert [one.run for one in statistics.run_trials(map_key(map_))] == ["s-2"]


@pytest.mark.thorough
def test_a_place_has_so_many_looks_at_most(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p", jpeg(0))
    for number in range(MOST_LOOKS):
        assert add_look(server, map_id, "p", jpeg(100 + number)).status_code == 201
    assert_problem(add_look(server, map_id, "p", jpeg(99)), 409, "too-many-looks")
    assert server.client.get(f"/v1/maps/{map_id}/places/p").json()["looks"] == MOST_LOOKS
    assert len(server.query(map_id, again(110), k=5)["matches"]) == 1


def test_the_listeners_of_a_map_hear_of_looks(server: Server, hall: str) -> None:
    with server.client.stream("GET", f"/v1/maps/{hall}/events", params={"kinds": "enrolment"}) as stream:
        lines = stream.iter_lines()
        next(lines)  # the stream is open
        add_look(server, hall, "p3", jpeg(72))
        told = next(line for line in lines if "look-added" in line)
    assert '"id":"p3"' in told.replace(" ", "")


def test_a_map_keeps_its_looks_in_a_file(server: Server, hall: str) -> None:
    client = server.client
    exported = client.get(f"/v1/maps/{hall}/export").content
    headers = {"Content-Type": "application/x-tar"}
    made = client.post("/v1/maps/import", params={"id": f"{hall}-2"}, content=exported, headers=headers)
    assert made.status_code == 201 and made.json()["places"] == 6
    as_job = {"id": f"{hall}-3", "background": "true"}
    job = finished(server, client.post("/v1/maps/import", params=as_job, content=exported, headers=headers).json())
    assert job["result"]["places"] == 6, "the look is no place"
    client.delete(f"/v1/maps/{hall}-3")
    assert server.query(f"{hall}-2", again(71))["place"]["id"] == "p1"
    (here,), (there,) = (client.get(f"/v1/maps/{name}/looks").json()["items"] for name in (hall, f"{hall}-2"))
    assert here == there
    client.delete(f"/v1/maps/{hall}-2")


def test_jobs_on_a_map_know_its_looks(server: Server, hall: str) -> None:
    """A merge brings looks along, once each, and so does a new encoding."""
    client, other = server.client, server.create_map("with-looks")["id"]
    report = done(server, other, "merge", **{"from": hall, "dry_run": False})
    assert (report["coming"], report["looks"], report["places"]) == (6, 1, 6)
    assert server.query(other, again(71))["place"]["id"] == "p1"
    again_merged = done(server, other, "merge", **{"from": hall, "dry_run": False})
    assert (again_merged["coming"], again_merged["looks"], again_merged["known"]) == (0, 0, 6)
    assert client.get(f"/v1/maps/{other}/places/p1").json()["looks"] == 1
    verified = client.post(f"/v1/maps/{other}/verify").json()
    assert verified["ok"] and (verified["places"], verified["rows"]) == (6, 7)
    client.delete(f"/v1/maps/{other}")
    refused = client.post(f"/v1/maps/{hall}/re-encode", json={"to": "without-images"})
    assert assert_problem(refused, 409, "images-missing")["detail"].startswith("7 frames of the 6 places")


def test_a_new_encoding_brings_looks_along(server: Server) -> None:
    name = server.create_map("imaged", keep="image")["id"]
    for number in range(3):
        server.enrol(name, f"p{number}", jpeg(number), sequence="day")
    add_look(server, name, "p1", jpeg(71), timestamp="2026-11-20T22:00:00Z")
    result = done(server, name, "re-encode", to="encoded-anew", encoder="m-region-vlad-thesis")
    assert result["places"] == 3 and result["left_out"]["count"] == 0
    (before,), (after,) = (
        server.client.get(f"/v1/maps/{map_id}/looks").json()["items"] for map_id in (name, "encoded-anew")
    )
    assert {**after, "regions": None} == {**before, "regions": None}
    assert server.query("encoded-anew", again(71))["matches"][0]["place"]["id"] == "p1"
    for map_id in (name, "encoded-anew"):
        server.client.delete(f"/v1/maps/{map_id}")
