"""The plan of a map: what its columns say, its revision, and what is kept of it."""

from __future__ import annotations

import gzip
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
import pytest

from core.ledger.maps import places
from core.ledger.maps.plan import HANDED_OVER, HAS_PICTURE
from core.maps import MapSettings
from core.store import Directory
from service.errors.faults import PlanTooLarge
from service.http.headers import accepts_gzip
from service.places import plans
from tests.core.store.frames import DIMENSION, LOCAL_SHAPE, frame
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem


def plan_of(server: Server, map_id: str, **parameters: str) -> dict[str, Any]:
    response = server.client.get(f"/v1/maps/{map_id}/plan", params=parameters)
    assert response.status_code == 200, response.text
    found: dict[str, Any] = response.json()
    return found


def test_the_columns_say_what_the_places_say(server: Server, map_id: str) -> None:
    moment = "2026-11-20T10:00:00.125Z"
    assert plan_of(server, map_id)["ids"] == []
    server.enrol(map_id, "p0", jpeg(0), x=1.23456, y=-2, heading=359.999, sequence="tuesday", timestamp=moment)
    server.enrol(map_id, "p1", jpeg(1), x=48.12345678, y=-11.5, sequence="monday")
    server.enrol(map_id, "p2", jpeg(2))
    server.client.delete(f"/v1/maps/{map_id}/places/p1")
    server.enrol(map_id, "p1", jpeg(1), x=48.12345678, y=-11.5, sequence="monday")
    plan = plan_of(server, map_id)
    milliseconds = round(1e3 * datetime.fromisoformat(moment).timestamp())
    assert plan == {
        "gaps": [],
        "gap_count": 0,
        "map": map_id,
        "revision": plan["revision"],
        "places": 3,
        "step": 1,
        "sequences": ["monday", "tuesday"],
        "ids": ["p0", "p2", "p1"],
        "sequence": [1, -1, 0],
        "x": [1.235, None, 48.123],
        "y": [-2.0, None, -11.5],
        "z": None,
        "latitude": None,
        "longitude": None,
        "heading": [360.0, None, None],
        "timestamp": [milliseconds, None, None],
        "flags": [HAS_PICTURE] * 3,
    }
    every_other = plan_of(server, map_id, step="2")
    assert every_other["places"] == 3 and set(every_other["ids"]) < set(plan["ids"]) and every_other["step"] == 2


def test_the_same_places_have_the_same_revision(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p0", jpeg(0), x=1, y=2)
    path = f"/v1/maps/{map_id}/plan"
    first = server.client.get(path)
    tag = first.headers["etag"]
    assert tag == f'W/"{first.json()["revision"]}"'
    server.client.patch(f"/v1/maps/{map_id}", json={"description": "not about places"})
    known = server.client.get(path, headers={"If-None-Match": tag})
    assert known.status_code == 304 and known.headers["etag"] == tag and not known.content
    server.client.patch(f"/v1/maps/{map_id}/places/p0", json={"pose": {"x": 1.5}})
    changed = server.client.get(path, headers={"If-None-Match": tag})
    assert changed.status_code == 200 and changed.headers["etag"] != tag and changed.json()["x"] == [1.5]
    server.client.patch(f"/v1/maps/{map_id}/places/p0", json={"pose": {"x": 1}})
    assert server.client.get(path, headers={"If-None-Match": tag}).status_code == 304, "as it was"
    server.client.delete(f"/v1/maps/{map_id}")
    assert_problem(server.client.get(path), 404, "unknown-map")
    server.create_map(map_id)
    assert plan_of(server, map_id)["ids"] == [], "the map of the same name is another one"


def test_it_is_compressed_for_those_who_accept_it(server: Server, traverse: str) -> None:
    path = f"{server.client.base_url}/v1/maps/{traverse}/plan"
    with httpx.stream("GET", path, headers={"Accept-Encoding": "gzip"}) as packed:
        assert packed.headers["content-encoding"] == "gzip" and packed.headers["vary"] == "Accept-Encoding"
        content = gzip.decompress(b"".join(packed.iter_raw()))
    plain = httpx.get(path, headers={"Accept-Encoding": "identity"})
    assert "content-encoding" not in plain.headers and plain.content == content
    assert len(plain.json()["ids"]) == 8


def test_what_a_header_allows() -> None:
    for header in ("gzip", "br, GZIP;q=0.5", "*", "identity, *;q=0.1"):
        assert accepts_gzip(header), header
    refused: tuple[str | None, ...] = (None, "", "br", "gzip;q=0", "*;q=0", "gzip;q=0, *", "gzip;q=x")
    assert not any(map(accepts_gzip, refused))


def test_a_plan_that_is_too_long_names_a_step(
    server: Server, map_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    atlas = Directory(tmp_path)
    lab = atlas.create("lab", "e@1", DIMENSION, MapSettings(), LOCAL_SHAPE)
    lab.enrol([frame(f"p{number}") for number in range(7)])
    monkeypatch.setattr(plans, "MOST_PLACES", 3)
    made = plans.Plans()
    with pytest.raises(PlanTooLarge, match="step=3 "):
        made.make(lab, 1)
    assert made.make(lab, 3) is made.cached(lab, 3)
    monkeypatch.setattr(plans, "MOST_BYTES", len(made.make(lab, 3).compressed) + 1)
    made.make(lab, 4)
    assert made.cached(lab, 3) is None and made.cached(lab, 4) is not None and made._bytes <= plans.MOST_BYTES
    lab.forget("p0")
    assert made.cached(lab, 4) is None
    atlas.close()
    for wrong in ("0", "-1", "x"):
        assert_problem(server.client.get(f"/v1/maps/{map_id}/plan", params={"step": wrong}), 422, "invalid-request")


def test_poses_that_were_handed_over_are_marked(tmp_path: Path) -> None:
    atlas = Directory(tmp_path)
    lab = atlas.create("lab", "e@1", DIMENSION, MapSettings(), LOCAL_SHAPE)
    lab.enrol([frame("p0"), frame("p1")])
    with lab._writing() as write:
        p1 = places.expect(write.connection, "p1")
        write.set_counterpart(p1, None, None, p1.place.pose, "p0")
    assert f'"flags":[{0},{HANDED_OVER}]' in lab.plan.columns().replace("2", "0").replace("3", "1")
    atlas.close()


def test_only_the_plans_that_were_requested_last_are_cached(tmp_path: Path) -> None:
    atlas = Directory(tmp_path)
    lab = atlas.create("lab", "e@1", DIMENSION, MapSettings(), LOCAL_SHAPE)
    made, steps = plans.Plans(), range(1, plans.MOST_CACHED + 3)
    for step in steps:
        made.make(lab, step)
    assert [step for step in steps if made.cached(lab, step) is not None] == list(steps[2:])
    atlas.close()
