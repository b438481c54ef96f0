"""Rebuilding the search index of a map, and verifying a map, as jobs over HTTP."""

from __future__ import annotations

from tests.service.map_jobs import enrol_many, finished
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem


def test_a_map_is_rebuilt_and_verified_in_the_background(server: Server) -> None:
    enrol_many(server, "rebuilt", 24, keep="none")
    assert server.client.patch("/v1/maps/rebuilt", json={"index": "compact"}).status_code == 200
    before = server.query("rebuilt", jpeg(3) + b"\x00" * 4)["matches"]
    asked = server.client.post("/v1/maps/rebuilt/rebuild")
    assert asked.status_code == 202 and asked.headers["location"] == f"/v1/jobs/{asked.json()['id']}"
    done = finished(server, asked.json())
    assert done["state"] == "succeeded" and done["kind"] == "rebuild", done
    index = done["result"]["index"]
    assert (index["tier"], index["rows_indexed"]) == ("compact", 24)
    assert done["progress"]["done"] == done["progress"]["total"] == 24
    assert server.query("rebuilt", jpeg(3) + b"\x00" * 4)["matches"] == before

    asked = server.client.post("/v1/maps/rebuilt/verify?background=true")
    assert asked.status_code == 202 and asked.json()["kind"] == "verify"
    report = finished(server, asked.json())["result"]
    assert report["ok"] and report["places"] == report["rows"] == 24
    assert report == server.client.post("/v1/maps/rebuilt/verify").json()
    for what in ("rebuild", "verify?background=true"):
        assert_problem(server.client.post(f"/v1/maps/nowhere/{what}"), 404, "unknown-map")
