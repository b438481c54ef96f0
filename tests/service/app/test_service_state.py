"""The state of the service over HTTP, and who sees how much of it."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest

from service.access.keys import Keys
from tests.service.scenes import jpeg
from tests.service.server import Server


def test_the_state_at_a_glance(server: Server, traverse: str) -> None:
    for _ in range(3):
        server.query(traverse, jpeg(1))
    state = server.client.get("/v1/service").json()
    assert state["ready"] and state["checks"]["encoder"] == "ok" and state["uptime_seconds"] > 0
    assert state["version"] == server.client.get("/version").json()["version"]
    (query,) = (one for one in state["requests"]["operations"] if one["path"] == "/v1/maps/{map}/query")
    assert query["method"] == "POST" and query["count"] >= 3 and query["errors"] == 0
    assert 0 < query["p50"] <= query["p90"] <= query["p99"] <= query["max"]
    assert state["requests"]["count"] >= query["count"] and state["requests"]["under_way"] >= 1
    assert state["queue"] == {"waiting": 0, "limit": 32} and state["storage"]["threads"] == 8
    assert state["maps"] >= 1 and state["limits"]["max_image_bytes"] == 16 * 1024 * 1024
    status = Path(f"/proc/{server.process.pid}/statm").read_text().split()
    assert 0.5 < state["memory"]["resident"] / (int(status[1]) * 4096) < 2
    assert 0 < state["disk"]["free"] < state["disk"]["total"]
    assert state["settings"]["port"] == server.port


@pytest.mark.thorough
def test_who_only_queries_sees_no_memory_and_no_settings(tmp_path: Path) -> None:
    store = Keys.of(tmp_path / "data")
    _, admin = store.create("ops", "admin")
    others = [store.create("robot", "query")[1], store.create("of-lab", "admin", ["lab"])[1]]
    server = Server(tmp_path, key=admin).wait()
    try:
        server.create_map("lab")
        server.create_map("yard")
        assert server.client.get("/v1/service").json()["settings"]
        for token, maps in zip(others, (2, 1), strict=True):
            headers = {"Authorization": f"Bearer {token}"}
            state = httpx.get(f"{server.client.base_url}/v1/service", headers=headers).json()
            assert (state["memory"], state["disk"], state["settings"]) == (None, None, None)
            assert state["maps"] == maps and state["limits"] and state["ready"]
            assert str(tmp_path) not in str(state)
    finally:
        assert server.stop() == 0
