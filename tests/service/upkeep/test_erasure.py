"""Erasing over HTTP: afterwards no file of the running service has bytes of what was erased."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from tests.core.recordings.bags import SECOND, START, compressed, write_ros1
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.map_jobs import asked, finished, places
from tests.service.places.test_looks import add_look
from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem
from tests.service.sessions.test_sessions import begin, send


@pytest.fixture(scope="module")
def erasing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with encoders that take no time."""
    folder = tmp_path_factory.mktemp("erasing")
    install_coarse_encoder(folder / "models")
    running = Server(folder, {"encoder": COARSE}).wait()
    yield running
    assert running.stop() == 0


def filled(server: Server, map_id: str) -> dict[str, bytes]:
    """A map of eight places in two traverses, which keeps images and every frame that it is asked; the images."""
    review = {"verdicts": ["recognized", "ambiguous", "unknown"], "most_frames": 60}
    server.create_map(map_id, encoder=COARSE, keep="image", same_place_radius=1.0, review=review)
    images = {f"p{number}": jpeg(number) for number in range(8)}
    for number, (name, image) in enumerate(images.items()):
        sequence, day = ("monday", 1) if number < 4 else ("tuesday", 2)
        given = {"x": 2 * number, "y": 0, "sequence": sequence, "timestamp": f"2026-11-0{day}T10:00:00Z"}
        assert server.enrol(map_id, name, image, **given).is_success
    return images


def ask(server: Server, map_id: str, count: int, **parameters: object) -> list[bytes]:
    """Ask for places 0 … count, and wait until the frames are stored for review."""
    asked_for = [encoded(seen_again(scene(number), 40 + number)) for number in range(count)]
    for frame in asked_for:
        server.query(map_id, frame, **parameters)
    until = time.monotonic() + 60
    while server.client.get(f"/v1/maps/{map_id}/review").json()["frames"] < count:
        assert time.monotonic() < until
        time.sleep(0.02)
    return asked_for


def stored(server: Server, map_id: str, place: str) -> dict[str, bytes]:
    """What the files have of a place: its descriptors and keypoints, byte for byte."""
    file = server.data_dir / "maps" / map_id / "map.sqlite"
    with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as connection:
        ((row,),) = connection.execute("SELECT row FROM places WHERE id = ?", (place,)).fetchall()
        parts = {}
        for what, column in (("descriptors", "bytes"), ("locals", "bytes"), ("keypoints", "record")):
            for (content,) in connection.execute(f"SELECT {column} FROM {what} WHERE row = ?", (row,)):
                parts[what] = content
    return {what: content for what, content in parts.items() if any(content)}


def found(server: Server, map_id: str, traces: dict[str, bytes]) -> set[str]:
    """Which of some bytes stand in which file of the data directory; of frames any part behind the header counts.

    Other maps, which have the same frames, are left out.
    """
    own, maps = server.data_dir / "maps" / map_id, server.data_dir / "maps"
    files = [path for path in server.data_dir.rglob("*") if own in path.parents or maps not in path.parents]
    contents = {path.name: path.read_bytes() for path in files if path.is_file()}
    return {
        f"{what} in {name}"
        for what, trace in traces.items()
        for at in range(700 if trace.startswith(b"\xff\xd8") else 0, max(1, len(trace) - 48), 499)
        for name, content in contents.items()
        if trace[at : at + 48] in content and any(trace[at : at + 48])
    }


def erased(server: Server, map_id: str, **order: Any) -> dict[str, Any]:
    job = finished(server, asked(server, map_id, "erase", **order))
    assert job["state"] == "succeeded", job
    result: dict[str, Any] = job["result"]
    return result


def test_a_place_is_erased_with_the_frames_that_are_about_it(erasing: Server) -> None:
    images = filled(erasing, "one")
    frames = ask(erasing, "one", 3)
    gone = {"image": images["p1"], "asked": frames[1], **stored(erasing, "one", "p1")}
    beside = {"image": images["p2"], **stored(erasing, "one", "p2")}
    assert {one.split(" in ")[0] for one in found(erasing, "one", gone)} == set(gone)
    best = {one["answer"]["best"] for one in erasing.client.get("/v1/maps/one/review").json()["items"]}
    result = erased(erasing, "one", ids=["p1", "gone"])
    assert result["places"] == 1 and result["rows"] == 1 and result["review"] >= 1 and "p1" in best
    assert found(erasing, "one", gone) == set()
    assert {one.split(" in ")[0] for one in found(erasing, "one", beside)} == set(beside)
    answers = erasing.client.get("/v1/maps/one/answers").json()["items"]
    assert result["answers"] >= 1 and not [one for one in answers if one["matches"][0]["place"] == "p1"]
    assert set(places(erasing, "one")) == set(images) - {"p1"}
    assert erasing.client.post("/v1/maps/one/verify").json()["ok"]
    assert erasing.query("one", jpeg(2))["matches"][0]["place"]["id"] == "p2"


@pytest.mark.thorough
def test_traverses_and_times_are_erased(erasing: Server) -> None:
    images = filled(erasing, "traverses")
    monday = {f"{n} {what}": trace for n in range(4) for what, trace in stored(erasing, "traverses", f"p{n}").items()}
    monday |= {f"{n} image": images[f"p{n}"] for n in range(4)}
    assert erased(erasing, "traverses", filter={"sequence": "monday"})["places"] == 4
    assert found(erasing, "traverses", monday) == set()
    tuesday = {f"{n} image": images[f"p{n}"] for n in range(4, 8)}
    assert len({one.split(" in ")[0] for one in found(erasing, "traverses", tuesday)}) == 4
    day = {"after": "2026-11-02T00:00:00Z", "before": "2026-11-03T00:00:00Z"}
    assert erased(erasing, "traverses", filter=day)["places"] == 4
    assert found(erasing, "traverses", tuesday) == set() and places(erasing, "traverses") == {}


@pytest.mark.thorough
def test_a_time_is_that_of_frames_for_review_too(erasing: Server) -> None:
    filled(erasing, "times")
    frames = ask(erasing, "times", 2)
    before = (datetime.now(UTC) - timedelta(hours=1)).isoformat()
    assert erased(erasing, "times", filter={"before": before, "sequence": "tuesday"})["review"] == 0
    result = erased(erasing, "times", filter={"after": before})
    assert (result["places"], result["review"], result["answers"]) == (0, 2, 2)
    assert found(erasing, "times", {"first": frames[0], "second": frames[1]}) == set()


def test_a_run_is_erased_and_ends(erasing: Server) -> None:
    images = filled(erasing, "runs")
    session = erasing.client.post("/v1/maps/runs/sessions", json={}).json()["id"]
    path = f"/v1/maps/runs/sessions/{session}"
    frame = encoded(seen_again(scene(2), 77))
    sent = erasing.client.post(f"{path}/frames", content=frame, headers={"Content-Type": "image/jpeg"})
    assert sent.is_success, sent.text
    other = ask(erasing, "runs", 2)
    until = time.monotonic() + 60
    while not found(erasing, "runs", {"frame": frame}):
        assert time.monotonic() < until
        time.sleep(0.02)
    result = erased(erasing, "runs", session=session)
    assert result["places"] == 0 and result["review"] == 1 and result["answers"] == 1
    assert found(erasing, "runs", {"frame": frame}) == set() and found(erasing, "runs", {"other": other[0]})
    assert erasing.client.get(path).status_code in (404, 410)
    assert set(places(erasing, "runs")) == set(images)


def test_frames_that_a_robot_sends_late_are_of_the_time_at_which_it_took_them(erasing: Server) -> None:
    filled(erasing, "late")
    session, frames = begin(erasing, "late"), [encoded(seen_again(scene(number), 90 + number)) for number in range(2)]
    for number, hour in enumerate((14, 15)):
        send(erasing, "late", session, frames[number], frame=number, timestamp=f"2026-11-20T{hour}:30:00Z")
    until = time.monotonic() + 60
    while erasing.client.get("/v1/maps/late/review").json()["frames"] < 2:
        assert time.monotonic() < until
        time.sleep(0.02)
    result = erased(erasing, "late", filter={"after": "2026-11-20T14:00:00Z", "before": "2026-11-20T15:00:00Z"})
    assert (result["places"], result["review"], result["answers"]) == (0, 1, 1)
    assert found(erasing, "late", {"frame": frames[0]}) == set() and found(erasing, "late", {"frame": frames[1]})


def test_places_that_were_deleted_before_are_erased_by_an_empty_order(erasing: Server) -> None:
    images = filled(erasing, "later")
    traces = {"image": images["p3"], **stored(erasing, "later", "p3")}
    assert erasing.client.delete("/v1/maps/later/places/p3").status_code == 204
    assert {one.split(" in ")[0] for one in found(erasing, "later", traces)} >= {"image", "descriptors"}
    result = erased(erasing, "later")
    assert (result["places"], result["rows"]) == (0, 1) and found(erasing, "later", traces) == set()
    assert erased(erasing, "later")["rows"] == 0


def test_bags_that_wait_are_named_and_go_if_the_order_says_so(erasing: Server, tmp_path: Path) -> None:
    images = filled(erasing, "bags")
    said = [compressed(START + number * SECOND, image) for number, image in enumerate(images.values())]
    data = write_ros1(tmp_path / "monday.bag", said).read_bytes()
    for name in ("monday.bag", "tuesday.bag"):
        sent = erasing.client.put(
            f"/v1/maps/bags/recordings/{name}", content=data, headers={"Content-Type": "application/octet-stream"}
        )
        assert sent.status_code == 200
    gone = {"image": images["p1"]}
    result = erased(erasing, "bags", ids=["p1"])
    assert (result["bags"], result["waiting_bags"]) == (0, ["monday.bag", "tuesday.bag"])
    assert found(erasing, "bags", gone) == {"image in monday.bag", "image in tuesday.bag"}
    result = erased(erasing, "bags", ids=["p1"], bags=True)
    assert (result["bags"], result["waiting_bags"]) == (2, [])
    assert found(erasing, "bags", gone) == set()
    assert erasing.client.get("/v1/maps/bags/recordings/monday.bag").json()["bytes"] == 0


def test_orders_that_say_two_things_or_nothing_are_refused(erasing: Server) -> None:
    filled(erasing, "orders")
    path = "/v1/maps/orders/erase"
    both = {"ids": ["p1"], "filter": {"sequence": "monday"}}
    refused: list[dict[str, Any]] = [both, {"filter": {}}, {"ids": []}, {"place": "p1"}]
    for order in refused:
        assert_problem(erasing.client.post(path, json=order), 422, "invalid-request")
    assert_problem(erasing.client.post("/v1/maps/nowhere/erase", json={}), 404, "unknown-map")
    assert len(places(erasing, "orders")) == 8


def with_look(server: Server, map_id: str, place: str, picture: bytes, **fields: object) -> str:
    """Add a look to a place; its address."""
    made = add_look(server, map_id, place, picture, **fields)
    assert made.status_code == 201, made.text
    return f"{place}/{made.json()['name']}"


def test_a_place_is_erased_with_its_looks(erasing: Server) -> None:
    filled(erasing, "looks")
    picture, other = jpeg(71), jpeg(72)
    look, beside = (with_look(erasing, "looks", *given) for given in (("p1", picture), ("p2", other)))
    gone = {"picture": picture, **stored(erasing, "looks", look)}
    stays = {"picture": other, **stored(erasing, "looks", beside)}
    assert {"descriptors", "keypoints"} < set(gone)
    assert {one.split(" in ")[0] for one in found(erasing, "looks", gone)} == set(gone)
    result = erased(erasing, "looks", ids=["p1"])
    assert (result["places"], result["looks"], result["rows"]) == (1, 0, 2)
    assert found(erasing, "looks", gone) == set()
    assert {one.split(" in ")[0] for one in found(erasing, "looks", stays)} == set(stays)
    assert erasing.query("looks", other)["matches"][0]["place"]["look"] == beside.partition("/")[2]
    assert erasing.client.post("/v1/maps/looks/verify").json()["ok"]


def test_one_look_is_erased_with_the_frame_for_review_that_became_it(erasing: Server) -> None:
    images = filled(erasing, "one-look")
    frame = ask(erasing, "one-look", 1)[0]
    (item,) = erasing.client.get("/v1/maps/one-look/review").json()["items"]
    order = {"place": "p5", "look": True}
    labelled = erasing.client.post(f"/v1/maps/one-look/review/{item['id']}", json=order).json()
    address = f"p5/{labelled['frame']['label']['look']}"
    gone = {"frame": frame, **stored(erasing, "one-look", address)}
    place = {"image": images["p5"], **stored(erasing, "one-look", "p5")}
    result = erased(erasing, "one-look", ids=[address, "p5/0000000000000000"])
    assert (result["places"], result["looks"], result["review"], result["rows"]) == (0, 1, 1, 1)
    assert found(erasing, "one-look", gone) == set()
    assert {one.split(" in ")[0] for one in found(erasing, "one-look", place)} == set(place)
    assert "looks" not in places(erasing, "one-look")["p5"] and len(places(erasing, "one-look")) == 8


@pytest.mark.thorough
def test_looks_of_a_time_and_of_a_camera_are_erased_and_their_places_stay(erasing: Server) -> None:
    images = filled(erasing, "visits")
    for camera in ("front", "rear"):
        assert erasing.client.put(f"/v1/maps/visits/cameras/{camera}", json={}).is_success
    visit = {"timestamp": "2026-11-20T14:30:00Z", "camera": "front"}
    given = {
        "visit": visit, "earlier": visit | {"timestamp": "2026-11-20T13:30:00Z"}, "rear": visit | {"camera": "rear"},
        "unknown": {},
    }  # fmt: skip
    pictures = {name: jpeg(80 + number) for number, name in enumerate(given)}
    looks = {name: with_look(erasing, "visits", "p1", pictures[name], **fields) for name, fields in given.items()}
    traces = {name: {"picture": pictures[name], **stored(erasing, "visits", look)} for name, look in looks.items()}
    hour = {"after": "2026-11-20T14:00:00Z", "before": "2026-11-20T15:00:00Z"}
    for conditions, going in (({**hour, "camera": "front"}, "visit"), (hour, "rear"), ({"camera": "front"}, "earlier")):
        result = erased(erasing, "visits", filter=conditions)
        assert (result["places"], result["looks"]) == (0, 1), going
        assert found(erasing, "visits", traces.pop(going)) == set()
    assert found(erasing, "visits", traces["unknown"]) and len(places(erasing, "visits")) == 8
    assert found(erasing, "visits", {"image": images["p1"]}) and places(erasing, "visits")["p1"]["looks"] == 1
    # With a traverse besides, a time chooses places alone.
    look = with_look(erasing, "visits", "p1", pictures["visit"], **visit)
    assert erased(erasing, "visits", filter={**hour, "sequence": "monday"})["looks"] == 0
    assert stored(erasing, "visits", look)


def learning(server: Server, map_id: str) -> list[dict[str, Any]]:
    """The jobs that learn for a map."""
    return [
        job for job in server.client.get("/v1/jobs").json()["items"] if job["kind"] == "learn" and job["map"] == map_id
    ]


def drive(server: Server, map_id: str, **fields: object) -> str:
    """A run of which the map would learn, and that goes on; its session."""
    session = begin(server, map_id)
    for number in range(8):
        pose = {"odometry_x": 2.0 * number, "odometry_y": 0.0, "odometry_heading": 0.0}
        send(server, map_id, session, encoded(seen_again(scene(number), 60 + number)), frame=number, **pose, **fields)
    return session


@pytest.mark.thorough
def test_a_map_learns_nothing_from_a_run_of_which_frames_were_erased(erasing: Server) -> None:
    filled(erasing, "taught")
    edited = erasing.client.patch("/v1/maps/taught", json={"learning": {"mode": "propose"}, "review": None})
    assert edited.is_success, edited.text
    path = "/v1/maps/taught/sessions"
    assert erasing.client.delete(f"{path}/{drive(erasing, 'taught')}").status_code == 204
    (first,) = learning(erasing, "taught")
    assert finished(erasing, first)["result"]["frames"] == 8
    # One that is erased ends, and teaches nothing.
    session = drive(erasing, "taught")
    erased(erasing, "taught", session=session)
    assert erasing.client.get(f"{path}/{session}").status_code == 404
    assert learning(erasing, "taught") == [finished(erasing, first)]
    # Of one that goes on, the notes go with its frames of the time that is erased: by the robot's clock, or by ours.
    for fields, conditions in (
        ({"timestamp": "2026-11-20T14:30:00Z"}, {"after": "2026-11-20T14:00:00Z", "before": "2026-11-20T15:00:00Z"}),
        ({}, {"after": (datetime.now(UTC) - timedelta(hours=1)).isoformat()}),
    ):
        session = drive(erasing, "taught", **fields)
        erased(erasing, "taught", filter=conditions)
        assert erasing.client.delete(f"{path}/{session}").status_code == 204
        assert len(learning(erasing, "taught")) == 1, conditions
    # Frames that come later are none of those.
    session = drive(erasing, "taught", timestamp="2026-11-21T14:30:00Z")
    erased(erasing, "taught", filter={"before": "2026-11-20T15:00:00Z"})
    assert erasing.client.delete(f"{path}/{session}").status_code == 204
    assert len(learning(erasing, "taught")) == 2


@pytest.mark.thorough
def test_an_erasure_goes_on_after_a_kill(tmp_path: Path) -> None:
    """The ids are noted first, so that the frames for review of deleted places go as well."""
    install_coarse_encoder(tmp_path / "models")
    running = Server(tmp_path, {"encoder": COARSE}).wait()
    images = filled(running, "killed")
    frames = ask(running, "killed", 4)
    traces = {f"{n} image": images[f"p{n}"] for n in range(4)} | {f"{n} asked": frames[n] for n in range(4)}
    job = asked(running, "killed", "erase", filter={"sequence": "monday"})
    running.kill()
    again = Server(tmp_path, {"encoder": COARSE}).wait()
    try:
        assert finished(again, job)["state"] == "succeeded"
        assert found(again, "killed", traces) == set() and len(places(again, "killed")) == 4
        assert again.client.post("/v1/maps/killed/verify").json()["ok"]
    finally:
        assert again.stop() == 0
