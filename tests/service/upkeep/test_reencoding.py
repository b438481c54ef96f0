"""Re-encoding a map while the old one serves: kills, changes and cancelling in between; jobs listed and followed."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest

from core.frames.images import decode
from core.maps import Enrolment, MapSettings
from core.places import PlaceFields, look_address
from service.engine.engine import Engine
from service.jobs.context import JobContext
from service.upkeep import reencoding
from tests.service.encoders import COARSE, TWO_STAGES, install_coarse_encoder, install_two_stage_encoder
from tests.service.engines import ENCODER, end_of, runtime_at
from tests.service.map_jobs import asked, enrol_many, finished, places, reaching
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem, text, typed

PLACES = 6


def fill(server: Server, name: str, count: int = PLACES, keep: str = "image") -> None:
    server.create_map(name, encoder=COARSE, keep=keep, description="hall", same_place_radius=1.5)
    for number in range(count):
        stamp = f"2026-11-20T10:00:{number:02}Z"
        fields: dict[str, Any] = {"x": 2 * number, "y": 0, "heading": 90, "timestamp": stamp, "metadata": {"n": number}}
        fields["sequence"] = "monday" if number % 2 else "tuesday"
        assert server.enrol(name, f"p{number}", jpeg(number), **fields).status_code == 201


def start(server: Server, name: str, to: str, encoder: str = TWO_STAGES) -> dict[str, Any]:
    return asked(server, name, "re-encode", to=to, encoder=encoder)


@pytest.mark.thorough
def test_a_map_is_re_encoded(server: Server) -> None:
    fill(server, "anew")
    server.client.patch("/v1/maps/anew/places/p1", json={"sequence": "tuesday"})  # last of its sequence from now on
    server.client.put("/v1/maps/anew/cameras/front", json={"mask": {"polygons": [[[0, 0.9], [1, 0.9], [1, 1]]]}})
    masked = server.enrol("anew", "masked", jpeg(30), camera="front")
    assert masked.status_code == 201, masked.text
    done = finished(server, start(server, "anew", "anew-2"))
    assert done["state"] == "succeeded", done
    assert done["result"]["left_out"] == {"count": 0, "places": []}
    assert done["result"]["places"] == PLACES + 1
    assert done["progress"] == {"done": PLACES + 1, "total": PLACES + 1, "message": ""}
    old, new = (server.client.get(f"/v1/maps/{name}").json() for name in ("anew", "anew-2"))
    assert new["encoder"] == done["result"]["encoder"] != old["encoder"]
    assert new["encoder"].startswith(TWO_STAGES)
    for field in ("description", "keep", "same_place_radius", "same_place_frames"):
        assert new[field] == old[field]
    before, after = places(server, "anew"), places(server, "anew-2")
    assert list(before) == list(after), "in the same order"
    for theirs, ours in zip(before.values(), after.values(), strict=True):
        assert {**ours, "regions": theirs["regions"]} == theirs, "every field but what the encoder found"
    cameras = [server.client.get(f"/v1/maps/{name}/cameras").json()["items"] for name in ("anew", "anew-2")]
    assert [camera["mask"] for camera in cameras[0]] == [camera["mask"] for camera in cameras[1]] != []
    answer = server.query("anew-2", encoded(seen_again(scene(3), 3)))
    assert answer["matches"][0]["place"]["id"] == "p3"
    assert server.client.get("/v1/maps/anew-2/places/p3/thumbnail").status_code == 200
    assert server.client.post("/v1/maps/anew-2/verify").json()["ok"]


def test_the_order_within_a_sequence_is_kept(server: Server) -> None:
    """The distance of two frames in a sequence decides whether they are rivals; it is the same in the new map."""
    server.create_map("order", encoder=COARSE, keep="image", same_place_frames=1)
    for number in range(4):
        assert server.enrol("order", f"p{number}", jpeg(number), sequence="monday").status_code == 201
    assert server.client.delete("/v1/maps/order/places/p1").status_code == 204  # leaves a gap in the count
    done = finished(server, start(server, "order", "order-2", COARSE))
    assert done["state"] == "succeeded"
    frame = encoded(seen_again(scene(0), 1))
    old, new = server.query("order", frame, k=10), server.query("order-2", frame, k=10)
    del old["milliseconds"], new["milliseconds"]
    assert old == new


@pytest.mark.parametrize(
    ("body", "status", "slug"),
    [
        ({"to": "Bad Id"}, 422, "invalid-identifier"),
        ({"to": "free", "encoder": "none-such"}, 422, "unknown-encoder"),
        ({"to": "bare"}, 409, "images-missing"),
        ({}, 422, "invalid-request"),
        ({"to": "free", "more": 1}, 422, "invalid-request"),
    ],
)
def test_a_request_that_cannot_be_fulfilled_is_refused(
    server: Server, body: dict[str, Any], status: int, slug: str
) -> None:
    if server.client.get("/v1/maps/bare").status_code == 404:
        fill(server, "bare", 2, keep="thumbnail")
    problem = assert_problem(server.client.post("/v1/maps/bare/re-encode", json=body), status, slug)
    if slug == "images-missing":
        assert problem["detail"].startswith("2 frames of the 2 places")


def test_a_name_that_is_taken_is_refused(server: Server) -> None:
    fill(server, "taken", 1)
    request = {"to": "taken", "encoder": TWO_STAGES}
    assert_problem(server.client.post("/v1/maps/taken/re-encode", json=request), 409, "map-exists")
    assert_problem(server.client.post("/v1/maps/none/re-encode", json=request), 404, "unknown-map")
    assert_problem(
        server.client.post("/v1/maps/taken/re-encode", content=b"{}", headers={"Content-Type": "text/plain"}),
        415,
        "unsupported-media-type",
    )


def test_frames_in_which_the_new_encoder_finds_nothing_are_listed(server: Server) -> None:
    server.create_map("dim", encoder="m-region-vlad", keep="image")
    assert server.enrol("dim", "clear", jpeg(1)).status_code == 201
    empty = finished(server, start(server, "dim", "dim-2", COARSE))
    assert empty["result"]["places"] + empty["result"]["left_out"]["count"] == 1


def hidden() -> bytes:
    """A frame that shows something in one spot alone."""
    frame = blank(320, 240)
    frame[100:120, 150:170] = 190
    return encoded(frame, ".png")


def test_a_place_that_is_left_out_takes_its_looks_along(server: Server) -> None:
    server.create_map("spotted", encoder="m-region-vlad-thesis", keep="image")
    server.client.put("/v1/maps/spotted/cameras/front", json={})
    for number in range(3):
        assert server.enrol("spotted", f"p{number}", jpeg(number)).status_code == 201
    assert server.enrol("spotted", "spot", hidden(), camera="front").status_code == 201
    for place, seed in (("spot", 71), ("p1", 72)):
        path = f"/v1/maps/spotted/places/{place}/looks"
        assert server.client.post(path, content=jpeg(seed), headers=typed(jpeg(seed))).status_code == 201
    mask = {"polygons": [[[0.3, 0.3], [0.7, 0.3], [0.7, 0.7], [0.3, 0.7]]]}  # from now on the spot is hidden
    assert server.client.put("/v1/maps/spotted/cameras/front", json={"mask": mask}).status_code == 200
    done = finished(server, start(server, "spotted", "spotted-2", COARSE))
    assert done["state"] == "succeeded", done
    assert done["result"]["places"] == 3
    assert [place["id"] for place in done["result"]["left_out"]["places"]] == ["spot"]
    assert [look["place"] for look in server.client.get("/v1/maps/spotted-2/looks").json()["items"]] == ["p1"]


def test_looks_follow_a_place_that_changes_while_its_map_is_re_encoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new frame of a place makes the job encode it again, and its looks with it, in the same round."""
    frames = {"first": jpeg(1), "second": jpeg(2), "empty": encoded(blank()), "look": jpeg(71)}

    def stored(place_id: str, shown: str) -> Enrolment:
        digest = hashlib.sha256(frames[shown]).digest()
        name = look_address(place_id, digest.hex()[:16]) if shown == "look" else place_id
        return Enrolment(name, PlaceFields(), np.ones(8, np.float32), 1, digest, image=frames[shown])

    def encode(engine: Engine, _context: Any, identity: str, files: Sequence[bytes], _masks: Any) -> list[Any]:
        encoder = engine.catalogue.get(identity)
        return [SimpleNamespace(encoding=encoder.encode(decode(data))) for data in files]

    monkeypatch.setattr(reencoding, "encode_after_requests", encode)  # without the queue of an event loop
    with runtime_at(tmp_path) as runtime:
        source = runtime.engine.maps.create("old", ENCODER, 8, MapSettings(keep="image"))
        source.enrol([stored("p", "first"), stored("p", "look")])
        identity = runtime.engine.catalogue.resolve("m-region-vlad-thesis")

        def work(context: JobContext) -> dict[str, Any]:
            job = reencoding._Reencoding(runtime.engine, context, "new", identity)
            found = []
            for shown in ("first", "second", "empty", "first"):
                source.enrol([stored("p", shown)])
                job._catch_up()
                made = [one.digest.hex() for one in job.made.transfer.outline(looks=True)]
                found.append([job._is_up_to_date(), made, list(job.left_out)])
            return {"found": found}

        done = end_of(runtime, runtime.jobs.submit("test", "old", work))
        first, second, look = (hashlib.sha256(frames[name]).hexdigest() for name in ("first", "second", "look"))
        assert done.result is not None, done
        assert done.result["found"] == [
            [True, [first, look], []],
            [True, [second, look], []],
            [True, [], ["p"]],
            [True, [first, look], []],
        ]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    install_coarse_encoder(tmp_path / "models")
    install_two_stage_encoder(tmp_path / "models")
    return tmp_path


MANY = 160


@pytest.mark.thorough
def test_kills_and_changes_in_between(folder: Path) -> None:
    """The service is killed twice and the old map changed meanwhile: the new map is listed only when it is complete."""
    server = Server(folder).wait()
    enrol_many(server, "lab", MANY)
    job = start(server, "lab", "lab-2")
    for kill in range(2):
        going = reaching(server, job, 32 * (kill + 1))
        assert going["state"] == "running", going
        assert server.client.get("/v1/maps/lab-2").status_code == 404
        assert [item["id"] for item in server.client.get("/v1/maps").json()["items"]] == ["lab"]
        request = {"id": "lab-2", "encoder": COARSE}
        assert_problem(server.client.post("/v1/maps", json=request), 409, "map-exists")
        changes = {"p3": {"metadata": {"kill": kill}}, "p90": {"sequence": f"moved-{kill}"}}
        for place, change in changes.items():
            assert server.client.patch(f"/v1/maps/lab/places/{place}", json=change).status_code == 200
        assert server.client.delete(f"/v1/maps/lab/places/p{kill}").status_code == 204
        assert server.enrol("lab", "p7", jpeg(40 + kill), sequence="monday").status_code == 200  # another frame
        assert server.enrol("lab", f"new{kill}", jpeg(50 + kill), sequence="monday").status_code == 201
        server.kill()
        server = Server(folder).wait()
    done = finished(server, job)
    assert done["state"] == "succeeded" and done["attempt"] == 3, done
    before, after = places(server, "lab"), places(server, "lab-2")
    assert len(before) == MANY and set(before) == set(after)
    for place_id, stored in before.items():
        assert {**after[place_id], "regions": stored["regions"]} == stored
    assert server.query("lab-2", jpeg(41))["matches"][0]["place"]["id"] == "p7"
    assert server.client.post("/v1/maps/lab-2/verify").json()["ok"]
    assert server.stop() == 0
    assert [path.name for path in sorted((folder / "data" / "maps").iterdir())] == ["lab", "lab-2"]


def is_on_disk(server: Server, name: str) -> bool:
    """Whether anything is left of a map, listed or not."""
    return any(name in path.name for path in (server.data_dir / "maps").iterdir())


@pytest.mark.thorough
def test_a_cancelled_job_leaves_nothing_and_the_old_map_serves_meanwhile(server: Server) -> None:
    enrol_many(server, "cancelling", MANY)
    job = start(server, "cancelling", "cancelled-map")
    reaching(server, job, 16)
    assert server.query("cancelling", jpeg(1))["matches"]
    request = {"to": "cancelled-map", "encoder": COARSE}
    assert_problem(server.client.post("/v1/maps/cancelling/re-encode", json=request), 409, "map-exists")
    cancelled = server.client.post(f"/v1/jobs/{job['id']}/cancel")
    assert cancelled.status_code == 200 and cancelled.json()["cancelling"]
    assert finished(server, job)["state"] == "cancelled"
    assert server.client.get("/v1/maps/cancelled-map").status_code == 404
    assert not is_on_disk(server, "cancelled-map") and is_on_disk(server, "cancelling")


@pytest.mark.thorough
def test_the_old_map_is_deleted_meanwhile(server: Server) -> None:
    enrol_many(server, "vanishing", MANY)
    job = start(server, "vanishing", "vanishing-2")
    reaching(server, job, 16)
    assert server.client.delete("/v1/maps/vanishing").status_code == 204
    failed = finished(server, job)
    assert failed["state"] == "failed"
    assert failed["problem"]["type"] == "urn:placerec:problem:unknown-map"
    assert not is_on_disk(server, "vanishing")


@pytest.mark.thorough
def test_a_job_and_those_who_follow_it_do_not_keep_the_service_from_stopping(folder: Path) -> None:
    server = Server(folder, {"shutdown_timeout": 120}).wait()
    enrol_many(server, "lab", 64)
    job = start(server, "lab", "lab-2")
    reaching(server, job, 1)
    with httpx.Client(base_url=server.client.base_url, timeout=60) as watcher:
        with watcher.stream("GET", f"/v1/jobs/{job['id']}/events") as response:
            stream = response.iter_lines()
            next(stream)
            began = time.monotonic()
            assert server.stop() == 0
            list(stream)
        assert time.monotonic() - began < 90, "requests under way would have had two minutes"
    server = Server(folder).wait()
    assert finished(server, job)["state"] == "succeeded"
    assert server.stop() == 0


def test_following_by_events(server: Server) -> None:
    fill(server, "followed")
    job = start(server, "followed", "followed-2")
    with server.client.stream("GET", f"/v1/jobs/{job['id']}/events") as response:
        assert response.headers["content-type"].startswith("text/event-stream")
        lines = [line for line in response.iter_lines() if line]
    names = [line.removeprefix("event: ") for line in lines if line.startswith("event: ")]
    idents = [line.removeprefix("id: ") for line in lines if line.startswith("id: ")]
    assert names[-1] == "succeeded" and len(set(idents)) == len(idents) == len(names)
    path = f"/v1/jobs/{job['id']}/events"
    seen = server.client.get(path, headers={"Last-Event-ID": idents[-1]})
    assert seen.status_code == 204 and not seen.content
    late = server.client.get(path, headers={"Last-Event-ID": "0.0"}).text
    assert late.count("event: ") == 1 and f"id: {idents[-1]}" in late
    assert_problem(server.client.get("/v1/jobs/none/events"), 404, "unknown-job")


def test_listing_and_reading_jobs(server: Server) -> None:
    fill(server, "listed", 1)
    jobs = [finished(server, start(server, "listed", f"listed-{n}", COARSE)) for n in range(2)]
    page = server.client.get("/v1/jobs", params={"map": "listed", "limit": 1}).json()
    assert [item["id"] for item in page["items"]] == [jobs[1]["id"]]
    rest = server.client.get("/v1/jobs", params={"map": "listed", "limit": 1, "cursor": page["next_cursor"]}).json()
    assert [item["id"] for item in rest["items"]] == [jobs[0]["id"]] and rest["next_cursor"] is None
    none = server.client.get("/v1/jobs", params=text({"map": "listed", "state": "failed"})).json()
    assert none == {"items": [], "next_cursor": None}
    assert_problem(server.client.get("/v1/jobs", params={"state": "odd"}), 422, "invalid-request")
    assert_problem(server.client.get("/v1/jobs", params={"cursor": page["next_cursor"]}), 422, "invalid-cursor")
    assert_problem(server.client.get("/v1/jobs/none"), 404, "unknown-job")
    assert_problem(server.client.get(f"/v1/jobs/{jobs[0]['id']}?wait=1000"), 422, "invalid-request")
    assert_problem(server.client.post("/v1/jobs/none/cancel"), 404, "unknown-job")
    assert_problem(server.client.post(f"/v1/jobs/{jobs[0]['id']}/cancel"), 409, "job-ended")
