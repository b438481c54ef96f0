"""Review over HTTP: doubtful frames are kept, seen, labelled, exported, and calibrate the map."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from core.maps import MapSettings, ReviewSetting
from core.store import Directory
from service.access.keys import Keys
from service.engine.review_keeper import MOST_WAITING, ReviewKeeper
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.map_jobs import finished
from tests.service.scenes import encoded, jpeg, scene, seen_again, stranger
from tests.service.server import Server, assert_problem, typed

ENCODER = "some@" + "0" * 64


@pytest.fixture(scope="module")
def reviewed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with an encoder that takes no time."""
    folder = tmp_path_factory.mktemp("review")
    install_coarse_encoder(folder / "models")
    running = Server(folder, {"encoder": COARSE}).wait()
    yield running
    assert running.stop() == 0


@pytest.fixture
def lab(reviewed: Server, request: pytest.FixtureRequest) -> str:
    """A map of six places that keeps every frame that it is asked."""
    name = f"m-{abs(hash(request.node.name)) % 10**9}"
    verdicts = ["recognized", "ambiguous", "unknown"]
    reviewed.create_map(name, same_place_radius=1.0, review={"verdicts": verdicts, "most_frames": 60})
    for number in range(6):
        assert reviewed.enrol(name, f"p{number}", jpeg(number), x=2 * number, y=0, sequence="monday").is_success
    return name


def kept(server: Server, map_id: str, count: int, **parameters: str) -> list[dict[str, Any]]:
    """The kept frames, as soon as there are so many; they are written a moment after the answer."""
    until = time.monotonic() + 60
    while True:
        page = server.client.get(f"/v1/maps/{map_id}/review", params=parameters).json()
        if page["frames"] >= count:
            items: list[dict[str, Any]] = page["items"]
            return items
        assert time.monotonic() < until, page
        time.sleep(0.02)


def label(server: Server, map_id: str, frame: int, **order: Any) -> dict[str, Any]:
    response = server.client.post(f"/v1/maps/{map_id}/review/{frame}", json=order)
    assert response.status_code == 200, response.text
    found: dict[str, Any] = response.json()
    return found


@pytest.mark.thorough
def test_a_map_stores_no_frames_unless_it_is_set_to(reviewed: Server) -> None:
    made = reviewed.create_map("silent")
    assert made["review"] is None
    assert reviewed.query("silent", jpeg(1))["verdict"] == "unknown"
    reviewed.client.patch("/v1/maps/silent", json={"review": {"verdicts": ["ambiguous"]}})
    assert reviewed.query("silent", jpeg(2))["verdict"] == "unknown"
    reviewed.client.patch("/v1/maps/silent", json={"review": {"verdicts": None}})
    reviewed.query("silent", jpeg(3))
    (frame,) = kept(reviewed, "silent", 1)
    assert frame["sha256"] == hashlib.sha256(jpeg(3)).hexdigest()
    edited = reviewed.client.patch("/v1/maps/silent", json={"review": None}).json()
    assert edited["review"] is None
    reviewed.query("silent", jpeg(4))
    assert len(kept(reviewed, "silent", 1)) == 1, "what was kept stays"


def test_the_setting_is_edited_field_by_field(reviewed: Server, lab: str) -> None:
    def patch(**review: object) -> httpx.Response:
        return reviewed.client.patch(f"/v1/maps/{lab}", json={"review": review})

    assert patch(most_frames=7).json()["review"]["verdicts"] == ["recognized", "ambiguous", "unknown"]
    again = patch(verdicts=["unknown"], most_frames=None).json()["review"]
    assert again == {"verdicts": ["unknown"], "most_frames": 500, "most_bytes": 256 << 20}
    wrong: list[dict[str, object]] = [
        {"verdicts": []},
        {"verdicts": ["maybe"]},
        {"most_frames": 0},
        {"most_bytes": 10},
        {"other": 1},
    ]
    for bad in wrong:
        assert_problem(patch(**bad), 422, "invalid-request")
    assert_problem(reviewed.client.patch(f"/v1/maps/{lab}", json={"review": True}), 422, "invalid-request")
    refused = reviewed.client.post("/v1/maps", json={"id": "no", "review": {"verdicts": ["maybe"]}})
    assert_problem(refused, 422, "invalid-request")


def test_a_stored_frame_has_its_answer(reviewed: Server, lab: str) -> None:
    frame = encoded(seen_again(scene(2)))
    answer = reviewed.client.post(
        f"/v1/maps/{lab}/query", content=frame, headers={**typed(frame), "X-Request-Id": "q-1"}
    ).json()
    (one,) = kept(reviewed, lab, 1)
    told = one["answer"]
    for name in ("verdict", "probability", "score", "decision", "threshold", "reason", "revision"):
        assert told[name] == answer[name], name
    assert told["best"] == answer["matches"][0]["place"]["id"] and told["request_id"] == "q-1"
    assert told["matches"] == [{"place": m["place"]["id"], "score": m["score"]} for m in answer["matches"][:5]]
    assert one["label"] is None and one["bytes"] == len(frame)
    picture = reviewed.client.get(f"/v1/maps/{lab}/review/{one['id']}/picture")
    assert picture.content == frame and picture.headers["content-type"] == "image/jpeg"
    assert_problem(reviewed.client.get(f"/v1/maps/{lab}/review/99/picture"), 404, "unknown-frame")


@pytest.mark.thorough
def test_pages_go_from_the_newest_to_the_oldest(reviewed: Server, lab: str) -> None:
    for number in range(7):
        reviewed.query(lab, jpeg(100 + number))
    kept(reviewed, lab, 7)
    found: list[int] = []
    cursor = ""
    while cursor is not None:
        page = reviewed.client.get(
            f"/v1/maps/{lab}/review", params={"limit": 3} | ({"cursor": cursor} if cursor else {})
        )
        found += [item["id"] for item in page.json()["items"]]
        cursor = page.json()["next_cursor"]
    assert found == sorted(found, reverse=True) and len(found) == 7
    assert_problem(reviewed.client.get(f"/v1/maps/{lab}/review?cursor=x"), 422, "invalid-cursor")


@pytest.mark.thorough
def test_frames_are_labelled_enrolled_and_thrown_away(reviewed: Server, lab: str) -> None:
    for number in range(4):
        reviewed.query(lab, encoded(stranger(200 + number)))
    ids = sorted(one["id"] for one in kept(reviewed, lab, 4))
    assert label(reviewed, lab, ids[0], place="p3")["frame"]["label"] == {"place": "p3", "new": None, "stranger": False}
    made = label(reviewed, lab, ids[1], new={"id": "fresh", "x": 50.0, "y": 1.0, "metadata": {"by": "hand"}})
    assert made["enrolled"]["pose"]["x"] == 50 and reviewed.places(lab)["fresh"]["metadata"] == {"by": "hand"}
    assert label(reviewed, lab, ids[1], new={"id": "fresh", "x": 50.0, "y": 1.0})["enrolled"]["id"] == "fresh"
    assert label(reviewed, lab, ids[2], stranger=True)["frame"]["label"]["stranger"]
    assert label(reviewed, lab, ids[3], place="p1")["frame"]["label"]["place"] == "p1"
    cleared = label(reviewed, lab, ids[3], clear=True)["frame"]
    assert (cleared["label"], cleared["labelled_at"], cleared["labelled_by"]) == (None, None, None)
    assert label(reviewed, lab, ids[3], discard=True) == {
        "id": ids[3], "discarded": True, "frame": None, "enrolled": None,
    }  # fmt: skip
    assert_problem(
        reviewed.client.post(f"/v1/maps/{lab}/review/{ids[3]}", json={"stranger": True}), 404, "unknown-frame"
    )
    exported = reviewed.client.get(f"/v1/maps/{lab}/review/labels").json()["items"]
    assert [(one["place"], one["enrolled"]) for one in exported] == [("p3", False), ("fresh", True), (None, False)]
    assert [one["id"] for one in kept(reviewed, lab, 3, labelled="false")] == []
    assert len(kept(reviewed, lab, 3, labelled="true")) == 3
    label(reviewed, lab, ids[0], stranger=True)
    assert reviewed.client.get(f"/v1/maps/{lab}/review/labels").json()["items"][0]["place"] is None


@pytest.mark.thorough
def test_a_frame_is_not_thrown_away_while_it_is_enrolled(reviewed: Server, lab: str) -> None:
    for number in range(6):
        reviewed.query(lab, encoded(stranger(300 + number)))
    ids = sorted(one["id"] for one in kept(reviewed, lab, 6))

    def say(order: tuple[int, dict[str, Any]]) -> int:
        return reviewed.client.post(f"/v1/maps/{lab}/review/{order[0]}", json=order[1]).status_code

    orders = [(one, said) for one in ids for said in ({"new": {"id": f"f{one}"}}, {"discard": True})]
    with ThreadPoolExecutor(len(orders)) as threads:
        told = list(threads.map(say, orders))
    there = reviewed.places(lab)
    for one, enrolled, discarded in zip(ids, told[::2], told[1::2], strict=True):
        assert discarded == 200 and enrolled in (200, 404)
        assert (f"f{one}" in there) == (enrolled == 200), "a frame that was gone is not enrolled"
    assert kept(reviewed, lab, 0) == []


def test_bad_labels_are_refused_and_change_nothing(reviewed: Server, lab: str) -> None:
    reviewed.query(lab, encoded(stranger(300)))
    (frame,) = kept(reviewed, lab, 1)
    there = f"/v1/maps/{lab}/review/{frame['id']}"
    post = reviewed.client.post
    two = ({"place": "p1", "stranger": True}, {"clear": True, "stranger": True})
    for bad in ({}, *two, {"stranger": False}, {"place": None}, {"discard": 1}, {"x": 1}):
        assert_problem(post(there, json=bad), 422, "invalid-request")
    assert_problem(post(there, json={"place": "nowhere"}), 404, "unknown-place")
    assert_problem(post(there, json={"place": "../x"}), 422, "invalid-identifier")
    assert_problem(post(there, json={"new": {"id": "p1"}}), 409, "place-taken")
    assert_problem(post(there, json={"new": {"id": "n1", "x": 1.0}}), 422, "invalid-request")
    assert_problem(post(there, json={"new": {"id": "n1", "camera": "none"}}), 404, "unknown-camera")
    assert_problem(post(there, content=b"place=p1"), 415, "unsupported-media-type")
    assert_problem(post(f"/v1/maps/{lab}/review/0", json={"stranger": True}), 422, "invalid-request")
    assert kept(reviewed, lab, 1)[0]["label"] is None and len(reviewed.places(lab)) == 6


@pytest.mark.thorough
def test_frames_of_sessions_and_batches_are_stored_too_and_survive_a_kill(tmp_path: Path) -> None:
    install_coarse_encoder(tmp_path / "models")
    server = Server(tmp_path, {"encoder": COARSE}).wait()
    server.create_map("lab", keep="none", review={"verdicts": ["unknown"]})
    session = server.client.post("/v1/maps/lab/sessions", json={}).json()["id"]
    path = f"/v1/maps/lab/sessions/{session}/frames?frame=3"
    assert server.client.post(path, content=jpeg(1), headers=typed(jpeg(1))).is_success
    form = {name: (name, jpeg(number), "image/jpeg") for number, name in enumerate(("two", "three"), start=2)}
    assert server.client.post("/v1/maps/lab/query:batch", files=form).is_success
    assert server.client.post("/v1/query?maps=lab", content=jpeg(4), headers=typed(jpeg(4))).is_success
    found = kept(server, "lab", 4)
    assert {(one["answer"]["session"], one["answer"]["frame"], one["answer"]["file"]) for one in found} == {
        (session, 3, None), (None, None, "two"), (None, None, "three"), (None, None, None),
    }  # fmt: skip
    label(server, "lab", found[0]["id"], stranger=True)
    server.kill()
    server = Server(tmp_path, {"encoder": COARSE}).wait()
    again = kept(server, "lab", 4)
    assert [one["id"] for one in again] == [one["id"] for one in found] and again[0]["label"]["stranger"]
    assert server.client.post("/v1/maps/lab/verify").json()["ok"]
    assert server.stop() == 0


@pytest.mark.thorough
def test_labels_calibrate_the_map(reviewed: Server) -> None:
    reviewed.create_map("hall", same_place_radius=1.0, review={"verdicts": ["recognized", "ambiguous", "unknown"]})
    for number in range(24):
        assert reviewed.enrol("hall", f"p{number}", jpeg(number), x=2 * number, y=0, sequence="monday").is_success

    def calibrate(**order: object) -> httpx.Response:
        return reviewed.client.post("/v1/maps/hall/calibrate", json={"method": "labels", "dry_run": True, **order})

    assert_problem(calibrate(), 422, "calibration-impossible")
    frames = [encoded(seen_again(scene(number), number)) for number in range(24)]
    for frame in frames:
        reviewed.query("hall", frame)
    shown = {hashlib.sha256(frame).hexdigest(): number for number, frame in enumerate(frames)}
    for one in kept(reviewed, "hall", 24):
        label(reviewed, "hall", one["id"], place=f"p{shown[one['sha256']]}")
    reviewed.query("hall", encoded(stranger(900)))
    label(reviewed, "hall", kept(reviewed, "hall", 25)[0]["id"], new={"id": "lonely", "x": 900.0, "y": 0.0})
    reviewed.query("hall", encoded(stranger(901)))
    label(reviewed, "hall", kept(reviewed, "hall", 26)[0]["id"], stranger=True)
    alone = calibrate(beside="none").json()
    assert alone["measurement"]["frames"] == 26 and alone["measurement"]["known"] == 24, alone
    assert alone["calibration"]["source"] == "labels" and not alone["stored"] and alone["warnings"]
    both = calibrate(beside="map").json()
    assert both["measurement"]["frames"] == 26 + 25
    assert "no curve" in assert_problem(calibrate(), 422, "calibration-impossible")["detail"]
    job = calibrate(beside="none", background=True, dry_run=False)
    assert job.status_code == 202
    done = finished(reviewed, job.json())
    assert done["state"] == "succeeded" and done["result"]["calibration"] == alone["calibration"]
    assert reviewed.client.get("/v1/maps/hall").json()["calibration"]["source"] == "labels"
    reviewed.client.delete("/v1/maps/hall/places/p3")
    assert calibrate(beside="none").json()["measurement"]["frames"] == 25, "a place that is gone is no truth"


@pytest.mark.thorough
def test_review_needs_the_role_enrol(tmp_path: Path) -> None:
    install_coarse_encoder(tmp_path / "models")
    store = Keys.of(tmp_path / "data")
    _, admin = store.create("ann", "admin")
    _, robot = store.create("robot", "query", ["lab"])
    _, operator = store.create("eve", "enrol", ["lab"])
    server = Server(tmp_path, {"encoder": COARSE}, key=admin).wait()
    server.create_map("lab", review={"verdicts": ["unknown"]})
    server.create_map("yard")
    there = {"Authorization": f"Bearer {robot}"}
    assert server.client.post("/v1/maps/lab/query", content=jpeg(1), headers={**typed(jpeg(1)), **there}).is_success
    (one,) = kept(server, "lab", 1)
    assert one["answer"]["key"] == "robot"
    for path in ("", "/labels", f"/{one['id']}/picture"):
        assert_problem(server.client.get(f"/v1/maps/lab/review{path}", headers=there), 403, "role-too-low")
    eve = {"Authorization": f"Bearer {operator}"}
    done = server.client.post(f"/v1/maps/lab/review/{one['id']}", json={"stranger": True}, headers=eve).json()
    assert done["frame"]["labelled_by"] == "eve"
    assert_problem(server.client.get("/v1/maps/yard/review", headers=eve), 403, "map-forbidden")
    assert server.stop() == 0


def test_more_frames_than_can_be_written_are_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    atlas = Directory(tmp_path / "data")
    map_ = atlas.create("lab", ENCODER, 8, MapSettings(review=ReviewSetting()))
    gate, keep = threading.Event(), map_.review.keep
    monkeypatch.setattr(map_.review, "keep", lambda *given: gate.wait(60) and keep(*given))
    keeper = ReviewKeeper()
    for number in range(MOST_WAITING + 10):
        keeper.offer(map_, np.uint32(number).tobytes(), {"verdict": "unknown"})
    assert 9 <= keeper.dropped <= 10, "one is being written, so many wait"
    gate.set()
    keeper.close()
    assert map_.review.page(None, 0).count == MOST_WAITING + 10 - keeper.dropped, "what waits at the end is written"
    before = keeper.dropped
    keeper.offer(map_, b"late", {"verdict": "unknown"})
    assert keeper.dropped == before + 1
    atlas.close()


@pytest.mark.thorough
def test_ten_labels_move_the_encoders_curve(server: Server) -> None:
    server.create_map("moved", same_place_radius=1.0, review={"verdicts": ["recognized", "ambiguous", "unknown"]})
    for number in range(6):
        assert server.enrol("moved", f"p{number}", jpeg(number), x=2 * number, y=0).is_success
    shown = {}
    for number in range(10):
        frame = encoded(seen_again(scene(number))) if number < 6 else encoded(stranger(number))
        shown[hashlib.sha256(frame).hexdigest()] = {"place": f"p{number}"} if number < 6 else {"stranger": True}
        server.query("moved", frame)
    for one in kept(server, "moved", 10):
        label(server, "moved", one["id"], **shown[one["sha256"]])
    report = server.client.post("/v1/maps/moved/calibrate", json={"method": "labels"}).json()
    trials, known = report["measurement"]["trials"], report["measurement"]["known"]
    assert report["stored"] and known == 6 and 10 < trials <= 16, "some are asked in the map without their places, too"
    before, after = report["previous"], report["calibration"]
    assert after["margin"] == before["margin"] and after["curve"] != before["curve"]
    assert server.client.get("/v1/maps/moved").json()["calibration"]["source"] == "labels"


def test_a_frame_becomes_a_look_of_the_place_that_it_shows(reviewed: Server, lab: str) -> None:
    night = encoded(stranger(3))
    reviewed.query(lab, night)
    (frame,) = kept(reviewed, lab, 1)
    told = label(reviewed, lab, frame["id"], place="p2", look=True)
    (look,) = reviewed.client.get(f"/v1/maps/{lab}/places/p2/looks").json()["items"]
    assert told["frame"]["label"]["place"] == "p2" and told["frame"]["label"]["look"] == look["name"]
    assert look["timestamp"] == frame["at"] and look["run"] is None
    assert reviewed.query(lab, night)["matches"][0]["place"]["id"] == "p2"
    again = label(reviewed, lab, frame["id"], place="p2", look=True)
    assert again["frame"]["label"]["look"] == look["name"], "the same frame gave the place a second look"
    (exported,) = reviewed.client.get(f"/v1/maps/{lab}/review/labels").json()["items"]
    assert (exported["place"], exported["enrolled"]) == ("p2", False)
    path = f"/v1/maps/{lab}/review/{frame['id']}"
    assert_problem(reviewed.client.post(path, json={"stranger": True, "look": True}), 422, "invalid-request")
