"""Bulk enrolment by a request and a job: its result, a crash, a cancel, and forms that are refused."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.service.conftest import TIGHT
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.map_jobs import finished, reaching, wait_until
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


@pytest.mark.thorough
def test_a_form_becomes_a_job_and_bad_frames_fail_alone(server: Server) -> None:
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
    assert [(place["id"], place["pose"]["x"]) for place in server.places("bulk").values()] == [("a", 1), ("b", 3)]
    assert server.client.get("/v1/maps/bulk/places/a/thumbnail").status_code == 200
    wait_until(lambda: staged(server) == [])  # it is cleared away once the job has ended

    again = finished(server, sent(server, "bulk", **form(pictures, listed)).json())
    assert again["result"]["changes"] == {"unchanged": 2}, "the same again changes nothing"


def test_a_job_of_which_no_frame_became_a_place_has_failed(server: Server, map_id: str) -> None:
    entries = [{"id": "a", "file": "bad"}, {"id": "b", "file": "none"}, {"id": "c", "sha256": "0" * 64}]
    job = finished(server, sent(server, map_id, **form({"bad": b"no picture"}, entries)).json())
    assert job["state"] == "failed" and job["result"] is None
    assert job["problem"]["type"].endswith(":nothing-enrolled")
    assert "None of the 3 frames became a place; the first, a: " in job["problem"]["detail"]
    assert [one["location"] for one in job["problem"]["errors"]] == ["a", "b", "c"]


def test_malformed_forms_are_refused_and_leave_nothing(server: Server) -> None:
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


@pytest.mark.thorough
def test_a_killed_job_is_resumed(tmp_path: Path) -> None:
    install_coarse_encoder(tmp_path / "models")
    coarse = {"encoder": COARSE}
    server = Server(tmp_path, coarse).wait()
    server.create_map("long")
    count = 128
    wanted = traverse(count)
    job = sent(server, "long", **wanted).json()
    reaching(server, job, 64)
    server.kill()
    (server.data_dir / "staging" / ".arriving").mkdir()  # as a request that was cut leaves it

    server = Server(tmp_path, coarse).wait()
    done = finished(server, job)
    assert done["state"] == "succeeded" and done["attempt"] == 2, done
    changes = done["result"]["changes"]
    assert sum(changes.values()) == count and changes.get("unchanged", 0) <= 64, changes
    assert list(server.places("long")) == [f"p{n}" for n in range(count)], "all of them, once, in their order"
    assert server.client.post("/v1/maps/long/verify").json()["ok"]
    wait_until(lambda: staged(server) == [])
    assert server.stop() == 0


@pytest.mark.thorough
def test_a_cancelled_job_keeps_what_is_enrolled_and_the_next_job_runs(server: Server) -> None:
    for name in ("cancelled", "next"):
        server.create_map(name, encoder=COARSE)
    count = 128
    job = sent(server, "cancelled", **traverse(count, "q", count)).json()
    waiting = sent(server, "next", **traverse(3, "w", 2 * count)).json()
    reaching(server, job, 64)
    assert server.client.post(f"/v1/jobs/{job['id']}/cancel").status_code == 200
    stopped = finished(server, job)
    assert stopped["state"] == "cancelled" and 64 <= len(server.places("cancelled")) < count
    assert stopped["progress"]["done"] <= len(server.places("cancelled"))
    assert finished(server, waiting)["result"]["changes"] == {"created": 3}
    wait_until(lambda: staged(server) == [])


@pytest.mark.thorough
def test_a_map_that_is_deleted_and_created_again_is_another_map(server: Server) -> None:
    for name in ("before", "again"):
        server.create_map(name, encoder=COARSE)
    first = sent(server, "before", **traverse(16, "x")).json()
    job = sent(server, "again", **traverse(3)).json()
    server.client.delete("/v1/maps/again")
    server.create_map("again", encoder=COARSE)
    lost = finished(server, job)
    if lost["state"] != "succeeded":  # the job may have ended before the map was deleted
        assert lost["problem"]["type"].endswith("unknown-map")
    assert server.places("again") == {}
    finished(server, first)
    wait_until(lambda: staged(server) == [])


def test_a_form_over_the_limit_is_refused(tight_server: Server, tight_map: str) -> None:
    big = form({"f": jpeg(1) + bytes(TIGHT["max_bulk_bytes"])}, [{"id": "b", "file": "f"}])
    assert_problem(sent(tight_server, tight_map, **big), 413, "body-too-large")
    assert staged(tight_server) == []
