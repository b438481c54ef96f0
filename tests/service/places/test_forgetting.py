"""Places that are listed and forgotten by conditions: the same places either way, all of them or none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from core.errors import InvalidCursor, TooManyToDelete
from core.maps import MapSettings
from core.maps.place_filter import PlaceFilter
from core.store import Directory
from tests.core.store.frames import DIMENSION, LOCAL_SHAPE, frame
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem

DAY = "2026-11-{:02}T10:00:00Z"


@pytest.fixture
def filled(server: Server, map_id: str) -> str:
    """A map of six places, of two traverses, two days and two floors."""
    server.client.put(f"/v1/maps/{map_id}/cameras/front", json={})
    for number in range(6):
        more: dict[str, Any] = {"camera": "front"} if number == 5 else {}
        if number < 4:
            more["timestamp"] = DAY.format(20 + number)
        response = server.enrol(
            map_id,
            f"p{number}",
            jpeg(number),
            sequence="monday" if number % 2 else "tuesday",
            metadata={"floor": number // 3, "wet": number == 0},
            **more,
        )
        assert response.status_code == 201, response.text
    return map_id


CONDITIONS: list[tuple[dict[str, Any], list[str]]] = [
    ({"sequence": "monday"}, ["p1", "p3", "p5"]),
    ({"camera": "front"}, ["p5"]),
    ({"after": DAY.format(22)}, ["p2", "p3"]),
    ({"before": DAY.format(21)}, ["p0", "p1"]),
    ({"after": DAY.format(21), "before": "2026-11-22T11:00:00+01:00", "sequence": "tuesday"}, ["p2"]),
    ({"where": {"floor": 1}}, ["p3", "p4", "p5"]),
    ({"where": {"floor": 1.0, "wet": False}, "sequence": "tuesday"}, ["p4"]),
    ({"where": {"wet": True}}, ["p0"]),
    ({"where": {"wet": 1}}, []),
    ({"where": {"floor": None}}, []),
    ({"sequence": "friday"}, []),
    ({"level": "1"}, ["p3", "p4", "p5"]),
    ({"level": 0, "sequence": "monday"}, ["p1"]),
]


def test_a_listing_and_a_dry_run_choose_the_same_places(server: Server, filled: str) -> None:
    places = f"/v1/maps/{filled}/places"
    for conditions, expected in CONDITIONS:
        parameters = {
            name: json.dumps(value) if isinstance(value, dict) else value for name, value in conditions.items()
        }
        page = server.client.get(places, params=parameters).json()
        assert [item["id"] for item in page["items"]] == expected, conditions
        would = server.client.post(f"{places}:delete", json={"filter": conditions}).json()
        assert would == {"dry_run": True, "places": len(expected), "ids": expected, "missing": []}, conditions
    assert len(server.places(filled)) == 6


def test_pages_of_a_filtered_listing(server: Server, filled: str) -> None:
    places = f"/v1/maps/{filled}/places"
    wanted = {"where": '{"floor": 1}', "limit": "2"}
    first = server.client.get(places, params=wanted).json()
    second = server.client.get(places, params=wanted | {"cursor": first["next_cursor"]}).json()
    assert [item["id"] for item in first["items"] + second["items"]] == ["p3", "p4", "p5"]
    assert second["next_cursor"] is None
    other = {"where": '{"floor": 0}', "limit": "2", "cursor": first["next_cursor"]}
    assert_problem(server.client.get(places, params=other), 422, "invalid-cursor")


def test_many_are_forgotten_in_one_request(server: Server, filled: str) -> None:
    forget = f"/v1/maps/{filled}/places:delete"
    before = server.client.get(f"/v1/maps/{filled}/plan").headers["etag"]
    done = server.client.post(forget, json={"ids": ["p4", "p0", "p4", "absent"], "dry_run": False})
    assert done.json() == {"dry_run": False, "places": 2, "ids": ["p0", "p4"], "missing": ["absent"]}
    assert list(server.places(filled)) == ["p1", "p2", "p3", "p5"]
    done = server.client.post(forget, json={"filter": {"sequence": "monday"}, "dry_run": False}).json()
    assert done["ids"] == ["p1", "p3", "p5"] and list(server.places(filled)) == ["p2"]
    again = server.client.post(forget, json={"filter": {"sequence": "monday"}, "dry_run": False}).json()
    assert again["places"] == 0
    assert {match["place"]["id"] for match in server.query(filled, jpeg(1))["matches"]} == {"p2"}
    assert server.client.get(f"/v1/maps/{filled}/plan").headers["etag"] != before
    assert [one["name"] for one in server.client.get(f"/v1/maps/{filled}/sequences").json()["items"]] == ["tuesday"]


def test_what_does_not_say_which_is_refused(server: Server, filled: str) -> None:
    forget = f"/v1/maps/{filled}/places:delete"
    wrong: list[dict[str, Any]] = [
        {},
        {"dry_run": False},
        {"ids": []},
        {"ids": ["p1"], "filter": {"sequence": "monday"}},
        {"filter": {}},
        {"filter": {"sequence": None}},
        {"filter": {"where": {}}},
        {"filter": {"where": {"floor": [1]}}},
        {"filter": {"floor": 1}},
        {"filter": {"after": DAY.format(22), "before": DAY.format(20)}},
        {"ids": ["p1"], "dry_run": "no"},
        {"ids": [f"p{number}" for number in range(10_001)]},
    ]
    for body in wrong:
        assert_problem(server.client.post(forget, json=body), 422, "invalid-request")
    for parameters in ({"where": "{"}, {"where": "[]"}, {"after": DAY.format(22), "before": DAY.format(20)}):
        response = server.client.get(f"/v1/maps/{filled}/places", params=parameters)
        assert_problem(response, 422, "invalid-request")
    assert_problem(server.client.post("/v1/maps/absent/places:delete", json={"ids": ["p"]}), 404, "unknown-map")
    assert len(server.places(filled)) == 6


def test_more_than_may_be_forgotten_at_once_are_all_kept(tmp_path: Path) -> None:
    atlas = Directory(tmp_path)
    lab = atlas.create("lab", "e@1", DIMENSION, MapSettings(), LOCAL_SHAPE)
    lab.enrol([frame(f"p{number}", sequence="s") for number in range(5)])
    wanted = PlaceFilter(sequence="s")
    for choose in (lab.ids_of, lab.forget_all):
        with pytest.raises(TooManyToDelete):
            choose(wanted, 4)
    assert lab.count_places() == 5
    assert lab.forget_all(wanted, 5) == [f"p{number}" for number in range(5)]
    assert lab.count_places() == 0 and lab.sequences(None, 10) == ([], None)
    _, cursor = (lab.enrol([frame("a"), frame("b")]), lab.places(None, 1)[1])
    with pytest.raises(InvalidCursor):
        lab.places(cursor, 1, PlaceFilter(camera="front"))
    atlas.close()
