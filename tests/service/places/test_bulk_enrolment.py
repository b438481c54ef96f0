"""A traverse enrolled by one request and a job: what comes of it, a kill in between, a cancel, and what is refused."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import httpx

from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.map_jobs import finished, places, reaching, wait_until
from tests.service.scenes import blank, encoded, jpeg
from tests.service.server import Server, assert_problem


def frames(count: int, offset: int = 0) -> list[bytes]:
    """Frames of different bytes that are quickly made."""
    drawn = [jpeg(number) for number in range(8)]
    return [drawn[n % 8] + b"\x00" * (n + 1 + offset) for n in range(count)]


def form(pictures: Mapping[str, bytes], entries: Sequence[Any]) -> dict[str, Any]:
    return {
        "data": {"places": json.dumps(entries)},
        "files": {name: (name, data, "image/jpeg") for name, data in pictures.items()},
    }


def traverse(count: int, name: str = "p", offset: int = 0) -> dict[str, Any]:
    pictures = {f"f{n}": data for n, data in enumerate(frames(count, offset))}
    return form(pictures, [{"id": f"{name}{n}", "file": f"f{n}", "x": n, "y": 0} for n in range(count)])


def sent(server: Server, map_id: str, **parts: Any) -> httpx.Response:
    return server.client.post(f"/v1/maps/{map_id}/places?background=true", **parts)


def staged(server: Server) -> list[str]:
    folder = server.data_dir / "staging"
    return [path.name for path in folder.iterdir()] if folder.is_dir() else []


def test_a_form_becomes_a_job_and_what_is_bad_fails_alone(server: Server) -> None:
    server.create_map("bulk", encoder=COARSE)
    listed = [
        {"id": "a", "file": "one", "x": 1, "y": 2, "sequence": "monday"},
        {"id": "white", "file": "blank"},
        {"id": "a", "file": "two"},
        {"id": "no id at all", "file": "two"},
        {"id": "lacking", "file": "three"},
        {"id": "b", "file": "two", "x": 3, "y": 2, "sequence": "monday"},
        {"id": "held", "sha256": "0" * 64},
    ]
    pictures = {"one": jpeg(1), "two": jpeg(2), "blank": encoded(blank())}
    response = sent(server, "bulk", **form(pictures, listed))
    assert response.status_code == 202, response.text
    job = response.json()
    assert response.headers["location"] == f"/v1/jobs/{job['id']}" and job["kind"] == "enrol" and job["resumable"]
    done = finished(server, job)
    assert done["state"] == "succeeded", done
    assert done["progress"] == {"done": 7, "total": 7, "message": ""}
    result = done["result"]
    assert result["changes"] == {"created": 2} and result["places"] == 2 and result["failed"]["count"] == 5
    failed = {
        item["position"]: (item["id"], item["problem"]["type"].rsplit(":", 1)[1]) for item in result["failed"]["items"]
    }
    assert failed == {
        1: ("white", "no-regions"),
        2: ("a", "invalid-request"),
        3: ("no id at all", "invalid-identifier"),
        4: ("lacking", "invalid-request"),
        6: ("held", "frame-needed"),
    }
    assert [(place["id"], place["pose"]["x"]) for place in places(server, "bulk").values()] == [("a", 1), ("b", 3)]
    assert server.client.get("/v1/maps/bulk/places/a/thumbnail").status_code == 200
    wait_until(lambda: staged(server) == [])  # it is cleared away once the job has ended

    again = finished(server, sent(server, "bulk", **form(pictures, listed)).json())
    assert again["result"]["changes"] == {"unchanged": 2}, "the same again changes nothing"


def test_what_makes_no_sense_is_refused_and_leaves_nothing(server: Server) -> None:
    server.create_map("refusing", encoder=COARSE)
    one = {"one": jpeg(1)}
    assert_problem(sent(server, "refusing", **form(one, [])), 422, "invalid-request")
    assert_problem(
        sent(server, "refusing", **form({**one, "spare": jpeg(2)}, [{"id": "a", "file": "one"}])),
        422,
        "invalid-request",
    )
    assert_problem(sent(server, "refusing", json={"places": []}), 415, "unsupported-media-type")
    assert_problem(sent(server, "absent", **form(one, [{"id": "a", "file": "one"}])), 404, "unknown-map")
    asserted = server.client.post("/v1/maps/refusing/places?background=true&encoder=other", **form(one, []))
    assert_problem(asserted, 409, "wrong-encoder")
    cut = b'--b\r\nContent-Disposition: form-data; name="places"\r\n\r\n[{"id"'
    header = {"Content-Type": "multipart/form-data; boundary=b"}
    assert_problem(sent(server, "refusing", content=cut, headers=header), 400, "malformed-body")
    assert staged(server) == [] and not server.client.get("/v1/jobs?map=refusing").json()["items"]


def test_a_kill_a_cancel_and_limits(tmp_path: Path) -> None:
    install_coarse_encoder(tmp_path / "models")
    limits = {"max_bulk_bytes": 8 << 20, "max_staged_bytes": 10 << 20, "max_bulk_items": 400}
    server = Server(tmp_path, limits).wait()
    server.create_map("long", encoder=COARSE)
    count = 128
    wanted = traverse(count)
    job = sent(server, "long", **wanted).json()
    reaching(server, job, 64)
    server.kill()
    (server.data_dir / "staging" / ".arriving").mkdir()  # as a request that was cut leaves it

    server = Server(tmp_path, limits).wait()
    done = finished(server, job)
    assert done["state"] == "succeeded" and done["attempt"] == 2, done
    told = done["result"]["changes"]
    assert sum(told.values()) == count and told.get("unchanged", 0) <= 64, told
    assert list(places(server, "long")) == [f"p{n}" for n in range(count)], "all of them, once, in their order"
    assert server.client.post("/v1/maps/long/verify").json()["ok"]
    wait_until(lambda: staged(server) == [])

    # What is enrolled when the job is cancelled stays; the other map's job has its turn.
    server.create_map("other", encoder=COARSE)
    job = sent(server, "other", **traverse(count, "q", count)).json()
    waiting = sent(server, "long", **traverse(3, "w", 2 * count)).json()
    reaching(server, job, 64)
    assert server.client.post(f"/v1/jobs/{job['id']}/cancel").status_code == 200
    stopped = finished(server, job)
    assert stopped["state"] == "cancelled" and 64 <= len(places(server, "other")) < count
    assert stopped["progress"]["done"] <= len(places(server, "other"))
    assert finished(server, waiting)["result"]["changes"] == {"created": 3}

    # A map that is deleted and made again is another map.
    first = sent(server, "long", **traverse(16, "x", 4 * count)).json()
    server.create_map("again", encoder=COARSE)
    job = sent(server, "again", **traverse(3)).json()
    server.client.delete("/v1/maps/again")
    server.create_map("again", encoder=COARSE)
    lost = finished(server, job)
    if lost["state"] != "succeeded":  # it may have come before
        assert lost["problem"]["type"].endswith("unknown-map")
    assert places(server, "again") == {}
    big = form(
        {f"f{n}": jpeg(n) + bytes(900_000) for n in range(10)}, [{"id": f"b{n}", "file": f"f{n}"} for n in range(10)]
    )
    assert_problem(sent(server, "again", **big), 413, "body-too-large")
    finished(server, first)
    until = time.monotonic() + 5
    while staged(server) and time.monotonic() < until:
        time.sleep(0.05)
    assert staged(server) == []
    assert server.stop() == 0
