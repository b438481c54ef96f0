"""Live events of maps over HTTP: what is told, to whom, and how a stream ends."""

from __future__ import annotations

import base64
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from service.access.keys import Keys
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.events.listening import listening
from tests.service.map_jobs import asked, finished, wait_until
from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem, text, typed

EVERYTHING = {"at", "map", "request_id", "key"}


def again(number: int) -> bytes:
    return encoded(seen_again(scene(number)))


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with an encoder that takes no time, and few listeners."""
    folder = tmp_path_factory.mktemp("events")
    install_coarse_encoder(folder / "models")
    running = Server(folder, {"encoder": COARSE, "event_listeners": 4}).wait()
    yield running
    assert running.stop() == 0


@pytest.fixture
def lab(quick: Server, request: pytest.FixtureRequest) -> str:
    """A map of three places in a row, of its own for each test."""
    name = f"m-{abs(hash(request.node.name)) % 10**9}"
    quick.create_map(name)
    for number in range(3):
        assert quick.enrol(name, f"p{number}", jpeg(number), x=2 * number, y=0, sequence="monday").is_success
    return name


@pytest.mark.thorough
def test_the_event_of_a_query_has_its_answer(quick: Server, lab: str) -> None:
    assert quick.client.put(f"/v1/maps/{lab}/cameras/front", json={}).is_success
    with listening(quick, lab) as ear:
        response = quick.client.post(
            f"/v1/maps/{lab}/query?camera=front", content=jpeg(1), headers={**typed(jpeg(1)), "X-Request-Id": "r-1"}
        )
        (event,) = ear.some(1)
    answer = response.json()
    assert event.name == "query" and event.data["map"] == lab and event.data["request_id"] == "r-1"
    assert event.data["operation"] == "query" and event.data["camera"] == "front" and event.data["key"] is None
    for name in ("verdict", "probability", "score", "decision", "threshold", "reason", "revision", "milliseconds"):
        assert event.data[name] == answer[name], name
    assert event.data["place"] == (answer["place"] or {"id": None})["id"]
    assert event.data["best"] == answer["matches"][0]["place"]["id"]
    assert event.data["pose"] == answer["pose"] and "picture" not in event.data


def test_all_kinds_of_queries_have_events(quick: Server, lab: str) -> None:
    session = quick.client.post(f"/v1/maps/{lab}/sessions", json={}).json()["id"]
    frames = f"/v1/maps/{lab}/sessions/{session}"
    with listening(quick, lab, parameters={"kinds": "query"}) as ear:
        quick.query(lab, jpeg(0))
        form = {name: (name, jpeg(number), "image/jpeg") for number, name in enumerate(("one", "two"))}
        assert quick.client.post(f"/v1/maps/{lab}/query:batch", files=form).is_success
        assert quick.client.post(
            f"/v1/maps/{lab}/query:enrol?id=p0", content=jpeg(0), headers=typed(jpeg(0))
        ).is_success
        assert quick.client.post(f"/v1/query?maps={lab}", content=jpeg(0), headers=typed(jpeg(0))).is_success
        assert quick.client.post(f"{frames}/frames?frame=4", content=jpeg(0), headers=typed(jpeg(0))).is_success
        with connect(f"ws://127.0.0.1:{quick.port}{frames}/stream", compression=None) as socket:
            socket.send(jpeg(1))
            socket.recv(timeout=60)
        told = ear.some(7)
    assert [one.data["operation"] for one in told] == [
        "query", "query_batch", "query_batch", "query_or_enrol", "query_maps", "send_frame", "stream_frames",
    ]  # fmt: skip
    assert [one.data["file"] for one in told] == [None, "one", "two", None, None, None, None]
    assert [one.data["session"] for one in told[5:]] == [session, session] and told[5].data["frame"] == 4
    assert all(one.data["milliseconds"] for one in told) and all(one.data.keys() > EVERYTHING for one in told)


def test_a_session_has_events_from_its_beginning_to_its_end(quick: Server, lab: str) -> None:
    with listening(quick, lab, parameters={"kinds": "session"}) as ear:
        session = quick.client.post(f"/v1/maps/{lab}/sessions", json={}).json()["id"]
        frames = f"/v1/maps/{lab}/sessions/{session}"
        answers = [
            quick.client.post(f"{frames}/frames?frame={n}", content=jpeg(n), headers=typed(jpeg(n))).json()
            for n in range(3)
        ]
        assert quick.client.delete(frames).status_code == 204
        told = ear.some(5)
    assert [one.data["change"] for one in told] == ["begun", *["moved"] * 3, "ended"]
    assert {one.data["session"] for one in told} == {session} and told[-1].data["reason"] == "It was deleted."
    for one, answer in zip(told[1:-1], answers, strict=True):
        for name in ("frame", "frames", "verdict", "probability", "unknown", "lost"):
            assert one.data[name] == answer[name], name
        place = answer["place"] or {"id": None, "pose": None}
        assert one.data["place"] == place["id"] and (one.data["pose"] is None) == (place["pose"] is None)
        assert place["pose"] is None or one.data["pose"]["x"] == place["pose"]["x"]


def test_a_session_that_expires_was_ended_by_nobody(quick: Server, lab: str) -> None:
    with listening(quick, lab, parameters={"kinds": "session"}) as ear:
        made = quick.client.post(f"/v1/maps/{lab}/sessions", json={"expires_after": 0.2}).json()
        wait_until(lambda: quick.client.get(f"/v1/maps/{lab}/sessions").json()["items"] == [])
        begun, event = ear.some(2)
    assert begun.data["session"] == made["id"] and begun.data["change"] == "begun"
    assert event.data["session"] == made["id"] and event.data["change"] == "ended"
    assert event.data["request_id"] is None


def test_enrolments_have_an_event_for_each_commit(quick: Server, lab: str) -> None:
    entries = [{"id": f"b{n}", "file": f"b{n}", "sequence": "tuesday"} for n in range(3)]
    form: dict[str, Any] = {"places": (None, json.dumps(entries), "application/json")}
    form |= {f"b{n}": (f"b{n}", jpeg(10 + n), "image/jpeg") for n in range(3)}
    with listening(quick, lab, parameters={"kinds": "enrolment,job"}) as ear:
        assert quick.enrol(lab, "p1", jpeg(1), x=2, y=0, sequence="monday").json()["change"] == "unchanged"
        assert quick.enrol(lab, "p9", jpeg(9), x=20, y=0).json()["change"] == "created"
        assert quick.enrol(lab, "p9", jpeg(8), x=20, y=0).json()["change"] == "replaced"
        assert quick.client.post(f"/v1/maps/{lab}/places", files=form).is_success
        assert quick.client.patch(f"/v1/maps/{lab}/places/p9", json={"pose": None}).is_success
        assert quick.client.delete(f"/v1/maps/{lab}/places/p9").is_success
        assert quick.client.delete(f"/v1/maps/{lab}/sequences/tuesday").is_success
        bulk = quick.client.post(
            f"/v1/maps/{lab}/places?background=true", files=form, headers={"X-Request-Id": "bulk-1"}
        ).json()
        assert finished(quick, bulk)["state"] == "succeeded"
        closed = quick.client.post(
            f"/v1/maps/{lab}/query:enrol?id=new", content=jpeg(77), headers=typed(jpeg(77))
        ).json()
        assert closed["enrolment"] == "created", closed
        order = {"ids": ["b0", "b1"], "dry_run": False}
        assert quick.client.post(f"/v1/maps/{lab}/places:delete", json=order).json()["places"] == 2
        assert quick.client.delete(f"/v1/maps/{lab}/places/b2").is_success
        told = ear.some(10, "enrolment")
    assert [one.data["changes"] for one in told] == [
        {"created": 1}, {"replaced": 1}, {"created": 3}, {"updated": 1}, {"deleted": 1}, {"deleted": 3},
        {"created": 3}, {"created": 1}, {"deleted": 2}, {"deleted": 1},
    ]  # fmt: skip
    assert [one.data["total"] for one in told] == [4, 4, 7, 7, 6, 3, 6, 7, 5, 4]
    assert told[0].data["places"] == [
        {"id": "p9", "change": "created", "sequence": None, "camera": None}
        | {"pose": told[0].data["places"][0]["pose"]}
    ]
    assert told[0].data["places"][0]["pose"]["x"] == 20
    assert [place["id"] for place in told[2].data["places"]] == ["b0", "b1", "b2"]
    assert told[5].data["sequence"] == "tuesday" and told[5].data["places"] == []
    assert told[6].data["operation"] == "enrol_places" and told[6].data["request_id"] == "bulk-1"
    states = [one.data["state"] for one in ear.heard if one.name == "job"]
    assert states[0] == "queued" and states[-1] == "succeeded" and "running" in states
    assert {one.data["job"] for one in ear.heard if one.name == "job"} == {bulk["id"]}


def test_changes_of_the_map_and_its_end_have_events(quick: Server, lab: str) -> None:
    with listening(quick, lab, parameters={"kinds": "map"}) as ear:
        quick.client.patch(f"/v1/maps/{lab}", json={"description": "changed", "same_place_radius": 3.0})
        quick.client.patch(f"/v1/maps/{lab}", json={"calibration": {"threshold": 0.3}})
        quick.client.put(f"/v1/maps/{lab}/cameras/front", json={})
        quick.client.delete(f"/v1/maps/{lab}/cameras/front")
        assert quick.client.delete(f"/v1/maps/{lab}").status_code == 204
        told = ear.some(5)
        assert ear.ended.wait(60), "the stream ends with the map"
    assert [one.data["change"] for one in told] == ["edited", "edited", "cameras", "cameras", "deleted"]
    assert told[0].data["fields"] == ["description", "same_place_radius"] and told[0].data["revision"] == 2
    assert told[1].data["fields"] == ["calibration"]
    assert_problem(quick.client.get(f"/v1/maps/{lab}/events"), 404, "unknown-map")


def test_a_job_over_two_maps_has_events_in_both(quick: Server, lab: str) -> None:
    quick.create_map("merged")
    quick.enrol("merged", "m1", jpeg(50))
    with listening(quick, lab) as ear, listening(quick, "merged", parameters={"kinds": "job"}) as other:
        job = asked(quick, lab, "merge", **{"from": "merged", "dry_run": False})
        assert finished(quick, job)["state"] == "succeeded"
        ear.wait(lambda heard: any(one.data.get("state") == "succeeded" for one in heard))
        other.wait(lambda heard: any(one.data.get("state") == "succeeded" for one in heard))
        assert [one.data["changes"] for one in ear.some(1, "enrolment")] == [{"created": 1}]
    assert other.heard[-1].data["job"] == job["id"] and other.heard[-1].data["map"] == "merged"
    assert other.heard[-1].data["job_kind"] == "merge"


def test_kinds_and_verdicts_are_chosen(quick: Server, lab: str) -> None:
    quick.create_map("empty-" + lab)
    with listening(quick, "empty-" + lab, parameters={"kinds": "query,map", "verdicts": "recognized"}) as ear:
        assert ear.heard[0].data == {
            "map": "empty-" + lab, "kinds": ["query", "map"], "verdicts": ["recognized"], "pictures": False,
        }  # fmt: skip
        assert quick.query("empty-" + lab, jpeg(1))["verdict"] == "unknown"
        quick.enrol("empty-" + lab, "p0", jpeg(0))
        quick.client.patch(f"/v1/maps/empty-{lab}", json={"description": "x"})
        ear.some(1)
    assert ear.names() == ["listening", "map"]
    for name in ("kinds", "verdicts"):
        for bad in ("", "x", "query,,map", "recognized;unknown"):
            refused = quick.client.get(f"/v1/maps/{lab}/events", params={name: bad})
            assert_problem(refused, 422, "invalid-request")


def test_a_listener_that_comes_again_goes_on_where_it_was(quick: Server, lab: str) -> None:
    with listening(quick, lab, parameters={"kinds": "query"}) as ear:
        quick.query(lab, jpeg(0))
        last = ear.some(1)[0].id
        start = ear.heard[0].id
    quick.query(lab, jpeg(1), k=1)
    quick.query(lab, jpeg(2), k=2)
    with listening(quick, lab, resumed=last) as ear:
        told = ear.some(2)
        assert [one.data["best"] for one in told] == ["p1", "p2"] and "missed" not in ear.names()
    with listening(quick, lab, resumed=start) as ear:
        assert [one.data["best"] for one in ear.some(3)] == ["p0", "p1", "p2"]
    with listening(quick, lab, resumed="another-service-1") as ear:
        (event,) = ear.some(1)
        assert event.name == "missed" and event.data == {"map": lab, "count": None}
        quick.query(lab, jpeg(1))
        assert ear.some(2)[1].name == "query"


def wait_for_no_listeners(server: Server) -> None:
    """Listeners that hung up are forgotten, a moment after."""
    wait_until(lambda: "placerec_event_listeners 0.0" in server.client.get("/metrics").text)


def test_listeners_are_bounded(quick: Server, lab: str) -> None:
    wait_for_no_listeners(quick)  # those of the tests before
    with listening(quick, lab), listening(quick, lab), listening(quick, lab), listening(quick, lab):
        refused = quick.client.get(f"/v1/maps/{lab}/events")
        assert_problem(refused, 503, "too-many-listeners")
        assert int(refused.headers["retry-after"]) > 0
        metrics = quick.client.get("/metrics").text
        assert "placerec_event_listeners 4.0" in metrics
    wait_for_no_listeners(quick)


def test_pictures_are_small_and_only_of_maps_that_keep_pictures(quick: Server, lab: str) -> None:
    frame = encoded(scene(1, 640, 480))
    with listening(quick, lab, parameters={"pictures": "true"}) as ear, listening(quick, lab) as plain:
        assert ear.heard[0].data["pictures"] is True
        quick.query(lab, frame)
        picture = ear.some(1)[0].data["picture"]
        assert "picture" not in plain.some(1)[0].data
        assert quick.client.patch(f"/v1/maps/{lab}", json={"keep": "none"}).is_success
        quick.query(lab, frame)
        assert ear.some(2, "query")[1].data["picture"] is None
    head, _, data = picture.partition(",")
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert head == "data:image/jpeg;base64" and pixels is not None and pixels.shape == (120, 160, 3)
    with listening(quick, lab, parameters={"pictures": "true"}) as ear:
        assert ear.heard[0].data["pictures"] is False


def test_the_head_of_a_stream_has_no_stream(quick: Server, lab: str) -> None:
    response = quick.client.head(f"/v1/maps/{lab}/events")
    assert response.status_code == 200 and response.headers["content-type"].startswith("text/event-stream")


# With keys


class Keyed:
    """A server with keys: of an administrator, of an operator and of a robot; the latter two for the map lab."""

    def __init__(self, folder: Path) -> None:
        install_coarse_encoder(folder / "models")
        self.store = Keys.of(folder / "data")
        _, self.admin = self.store.create("ann", "admin")
        self.robot_key, self.robot = self.store.create("robot", "query", ["lab"])
        _, self.operator = self.store.create("eve", "enrol", ["lab"])
        self.server = Server(folder, {"encoder": COARSE}, key=self.admin).wait()


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Keyed]:
    made = Keyed(tmp_path_factory.mktemp("keyed-events"))
    for name in ("lab", "yard"):
        made.server.create_map(name)
        assert made.server.enrol(name, "p1", jpeg(1)).status_code == 201
    yield made
    assert made.server.stop() == 0


def test_a_robot_sees_its_map_and_not_the_callers(keyed: Keyed) -> None:
    there = {"Authorization": f"Bearer {keyed.robot}"}
    get = keyed.server.client.get
    assert_problem(get("/v1/maps/yard/events", headers=there), 403, "map-forbidden")
    assert_problem(get("/v1/maps/lab/events?pictures=true", headers=there), 403, "role-too-low")
    assert_problem(get("/v1/maps/lab/events", headers={"Authorization": ""}), 401, "key-needed")
    with (
        listening(keyed.server, "lab", keyed.robot, parameters={"kinds": "query"}) as robot,
        listening(keyed.server, "lab", keyed.operator, parameters={"kinds": "query", "pictures": "true"}) as operator,
    ):
        keyed.server.query("lab", jpeg(1), explain="true")
        seen, all_ = robot.some(1)[0].data, operator.some(1)[0].data
    assert all_["key"] == "ann" and all_["picture"].startswith("data:image/jpeg")
    assert all_["explanation"].startswith("/v1/maps/lab/explanations/")
    assert all_.keys() - seen.keys() == {"key", "explanation", "picture"}


def test_a_job_that_names_a_map_of_others_is_hidden(keyed: Keyed) -> None:
    with (
        listening(keyed.server, "lab", keyed.operator, parameters={"kinds": "job"}) as operator,
        listening(keyed.server, "lab", keyed.admin, parameters={"kinds": "job"}) as admin,
    ):
        finished(keyed.server, asked(keyed.server, "lab", "merge", **{"from": "yard"}))
        own = asked(keyed.server, "lab", "prune", dry_run=True)
        finished(keyed.server, own)
        for ear in (operator, admin):
            ear.wait(
                lambda heard: any(one.data.get("job") == own["id"] and one.data["state"] != "queued" for one in heard)
            )
    assert {one.data["job"] for one in operator.heard if one.name == "job"} == {own["id"]}
    assert len({one.data["job"] for one in admin.heard if one.name == "job"}) == 2


@pytest.mark.thorough
def test_a_stream_ends_when_its_key_is_revoked(keyed: Keyed) -> None:
    key, token = keyed.store.create("guest", "query", ["lab"])
    until = time.monotonic() + 90
    there = {"Authorization": f"Bearer {token}"}
    while keyed.server.client.get("/v1/maps/lab", headers=there).status_code != 200:
        assert time.monotonic() < until
        time.sleep(1)
    with listening(keyed.server, "lab", token) as guest, listening(keyed.server, "lab", keyed.admin) as admin:
        keyed.store.revoke(key.id)
        while keyed.server.client.get("/v1/maps/lab", headers=there).status_code != 401:
            assert time.monotonic() < until
            time.sleep(0.5)
        keyed.server.query("lab", jpeg(1))
        assert guest.ended.wait(60)
        admin.some(1, "query")
        assert guest.names() == ["listening"]


@pytest.mark.thorough
def test_listeners_do_not_keep_the_service_from_stopping(tmp_path: Path) -> None:
    install_coarse_encoder(tmp_path / "models")
    server = Server(tmp_path, {"encoder": COARSE, "shutdown_timeout": 120}).wait()
    server.create_map("lab")
    with listening(server, "lab") as ear:
        began = time.monotonic()
        assert server.stop() == 0
        assert ear.ended.wait(60) and time.monotonic() - began < 60, "requests under way would have had two minutes"


@pytest.mark.thorough
def test_two_hundred_queries_from_eight_callers_have_one_event_each(quick: Server, lab: str) -> None:
    with listening(quick, lab, parameters={"kinds": "query", "pictures": "true"}) as ear:

        def ask(caller: int) -> None:
            with httpx.Client(base_url=quick.client.base_url, timeout=60) as client:
                for number in range(25):
                    frame = jpeg(number % 3)
                    path, name = f"/v1/maps/{lab}/query", {"X-Request-Id": f"c{caller}-{number}"}
                    while client.post(path, params=text({"k": 1}), content=frame, headers=typed(frame) | name).is_error:
                        time.sleep(0.05)

        callers = [threading.Thread(target=ask, args=(number,)) for number in range(8)]
        for caller in callers:
            caller.start()
        for caller in callers:
            caller.join()
        told = ear.some(200)
    assert {one.data["request_id"] for one in told} == {f"c{c}-{n}" for c in range(8) for n in range(25)}
    assert [int(one.id.rpartition("-")[2]) for one in told] == sorted(int(one.id.rpartition("-")[2]) for one in told)
