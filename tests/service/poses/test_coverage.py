"""Whether a pose is in a map, over HTTP and by the command."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem


def coverage(server: Server, map_id: str, **pose: float) -> dict[str, Any]:
    response = server.client.get(f"/v1/maps/{map_id}/coverage", params=pose)
    assert response.status_code == 200, response.text
    found: dict[str, Any] = response.json()
    return found


@pytest.fixture(scope="module")
def walked(server: Server) -> str:
    """Two traverses along one corridor, there and back, with a gap of 20 m, and a look of one place."""
    server.create_map("strolled", same_place_radius=3)
    for number, x in enumerate((0, 2, 4, 24)):
        server.enrol("strolled", f"a{number}", jpeg(number), x=x, y=0, heading=0, sequence="there")
        server.enrol("strolled", f"b{number}", jpeg(10 + number), x=x, y=1, heading=180, sequence="back")
    dark = encoded(seen_again(scene(1)))
    added = server.client.post(
        "/v1/maps/strolled/places/a1/looks", content=dark, headers={"Content-Type": "image/jpeg"}
    )
    assert added.is_success, added.text
    server.enrol("strolled", "nowhere", jpeg(20))
    return "strolled"


def test_a_pose_in_the_map(server: Server, walked: str) -> None:
    found = coverage(server, walked, x=2, y=0, heading=5, k=2)
    assert (found["state"], found["radius"], found["gap"]) == ("covered", 3, None)
    assert (found["places"], found["looks"]) == (6, 7)
    assert found["sequences"] == ["back", "there"]
    assert found["directions"] == [4, 0, 0, 0, 3, 0, 0, 0]
    assert (found["distance"], found["turn"]) == (0, 5)
    assert [one["place"] for one in found["nearest"]] == ["a1", "b1"]
    assert found["nearest"][1] == {"place": "b1", "distance": 1, "turn": 175, "sequence": "back"}


def test_poses_that_are_not_in_it(server: Server, walked: str) -> None:
    across = coverage(server, walked, x=2, y=0, heading=90)
    assert (across["state"], across["turn"]) == ("other-direction", 90)
    gap = coverage(server, walked, x=14, y=0, heading=0)
    assert gap["state"] == "gap" and (gap["places"], gap["looks"], gap["sequences"]) == (0, 0, [])
    assert gap["gap"] == {"before": "a2", "after": "a3", "metres": 20, "aside": 0}
    outside = coverage(server, walked, x=2, y=-50, k=1)
    assert outside["state"] == "outside" and outside["gap"] is None and outside["turn"] is None
    assert outside["nearest"][0]["place"] == "a1" and outside["distance"] == 50
    assert coverage(server, walked, x=2, y=0, k=0)["nearest"] == []


def test_a_map_without_poses(server: Server, map_id: str) -> None:
    empty = coverage(server, map_id, x=0, y=0)
    assert (empty["state"], empty["distance"], empty["nearest"]) == ("outside", None, [])
    server.enrol(map_id, "p", jpeg(1))
    assert coverage(server, map_id, latitude=48, longitude=2)["state"] == "outside"


@pytest.mark.parametrize(
    ("pose", "reason"),
    [
        ({}, "a pose is either"),
        ({"x": 1}, "needs x and y"),
        ({"x": 1, "y": 1, "latitude": 1, "longitude": 1}, "is either"),
        ({"x": "nan", "y": 1}, "x"),
        ({"x": 1, "y": 1, "radius": 5}, "radius"),
    ],
)
def test_what_is_no_pose_is_refused(server: Server, walked: str, pose: Any, reason: str) -> None:
    response = server.client.get(f"/v1/maps/{walked}/coverage", params=pose)
    problem = assert_problem(response, 422, "invalid-request")
    assert reason in json.dumps(problem)


def test_a_map_in_degrees(server: Server, map_id: str) -> None:
    for number in range(3):
        server.enrol(map_id, f"p{number}", jpeg(number), latitude=48 + number * 1e-5, longitude=2, sequence="s")
    found = coverage(server, map_id, latitude=48.000005, longitude=2)
    assert found["state"] == "covered" and found["distance"] == pytest.approx(0.556, abs=0.01)
    refused = server.client.get(f"/v1/maps/{map_id}/coverage", params={"x": 0, "y": 0})
    assert "geographic" in assert_problem(refused, 409, "mixed-coordinates")["detail"]


def test_an_unknown_map(server: Server) -> None:
    assert_problem(server.client.get("/v1/maps/nowhere/coverage", params={"x": 0, "y": 0}), 404, "unknown-map")
