"""When frames were taken: a date that is yet to come is refused, whichever way a place gets it."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from tests.service.map_jobs import finished
from tests.service.scenes import jpeg
from tests.service.server import Server, text, typed

Way = Callable[[Server, str, str], dict[str, Any]]


def form(taken: str) -> dict[str, Any]:
    listed = json.dumps([{"id": "new", "file": "one", "timestamp": taken}])
    return {"data": {"places": listed}, "files": {"one": ("1.jpg", jpeg(1), "image/jpeg")}}


def put(server: Server, map_id: str, taken: str) -> dict[str, Any]:
    return dict(server.enrol(map_id, "new", jpeg(1), timestamp=taken).json())


def change(server: Server, map_id: str, taken: str) -> dict[str, Any]:
    return dict(server.client.patch(f"/v1/maps/{map_id}/places/old", json={"timestamp": taken}).json())


def look(server: Server, map_id: str, taken: str) -> dict[str, Any]:
    path, asked = f"/v1/maps/{map_id}/places/old/looks", text({"timestamp": taken})
    return dict(server.client.post(path, params=asked, content=jpeg(1), headers=typed(jpeg(1))).json())


def batch(server: Server, map_id: str, taken: str) -> dict[str, Any]:
    (item,) = server.client.post(f"/v1/maps/{map_id}/places", **form(taken)).json()["items"]
    return dict(item.get("problem", item))


def job(server: Server, map_id: str, taken: str) -> dict[str, Any]:
    begun = server.client.post(f"/v1/maps/{map_id}/places?background=true", **form(taken)).json()
    done = finished(server, begun)
    return dict(done["problem"] or done["result"])


def closure(server: Server, map_id: str, taken: str) -> dict[str, Any]:
    path, asked = f"/v1/maps/{map_id}/query:enrol", text({"timestamp": taken, "id": "new"})
    return dict(server.client.post(path, params=asked, content=jpeg(1), headers=typed(jpeg(1))).json())


@pytest.mark.parametrize("way", [put, change, look, batch, job, closure])
def test_a_date_that_is_yet_to_come_is_refused(server: Server, map_id: str, way: Way) -> None:
    server.enrol(map_id, "old", jpeg(0))
    now = datetime.now(UTC)
    later = (now + timedelta(days=7300)).isoformat()
    told = way(server, map_id, later)
    assert told["type"].endswith((":invalid-request", ":nothing-enrolled")), told
    assert all(part in told["detail"] for part in (f"timestamp: {later[:19]}", f"clock, {now.isoformat()[:11]}"))
    assert server.places(map_id).keys() == {"old"} and server.places(map_id)["old"]["timestamp"] is None
    assert "type" not in way(server, map_id, (now - timedelta(days=7300)).isoformat()), "a recording of old is none"
    assert "type" not in way(server, map_id, (now + timedelta(hours=14)).isoformat()), "nor is the time of another zone"
