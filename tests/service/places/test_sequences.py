"""Traverses over HTTP: list, count and delete them."""

from __future__ import annotations

from urllib.parse import quote

from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem


def test_traverses_are_listed_counted_and_deleted(server: Server, map_id: str) -> None:
    for number in range(5):
        name = "afternoon" if number % 2 else "morning"
        server.enrol(map_id, f"p{number}", jpeg(number), sequence=name, timestamp=f"2026-11-20T10:0{number}:00Z")
    server.enrol(map_id, "alone", jpeg(7))
    path = f"/v1/maps/{map_id}/sequences"
    listed = server.client.get(path).json()
    assert listed == {
        "items": [
            {
                "name": "afternoon",
                "places": 2,
                "first_at": "2026-11-20T10:01:00Z",
                "last_at": "2026-11-20T10:03:00Z",
            },
            {"name": "morning", "places": 3, "first_at": "2026-11-20T10:00:00Z", "last_at": "2026-11-20T10:04:00Z"},
        ],
        "next_cursor": None,
    }
    first = server.client.get(path, params={"limit": 1}).json()
    second = server.client.get(path, params={"limit": 1, "cursor": first["next_cursor"]}).json()
    assert [first["items"][0]["name"], second["items"][0]["name"]] == ["afternoon", "morning"]

    gone = server.client.delete(f"{path}/morning")
    assert gone.json() == {"name": "morning", "places": 3}
    assert_problem(server.client.delete(f"{path}/morning"), 404, "unknown-sequence")
    left = {item["id"] for item in server.client.get(f"/v1/maps/{map_id}/places").json()["items"]}
    assert left == {"p1", "p3", "alone"}
    found = {match["place"]["id"] for match in server.query(map_id, jpeg(0), k=100)["matches"]}
    assert found == left, "the deleted ones are not found by any later query"


def test_a_traverse_may_have_any_name(server: Server, map_id: str) -> None:
    for name in ("Montag früh", "日本", "100%?#&", "a:b;c", "..."):
        server.enrol(map_id, "p", jpeg(1), sequence=name)
        assert server.client.get(f"/v1/maps/{map_id}/places/p").json()["sequence"] == name
        response = server.client.delete(f"/v1/maps/{map_id}/sequences/{quote(name, safe='')}")
        assert response.json() == {"name": name, "places": 1}


def test_names_that_no_traverse_has(server: Server, map_id: str) -> None:
    for path in ("absent", "%F0%28%8C"):
        response = server.client.delete(f"/v1/maps/{map_id}/sequences/{path}")
        assert response.status_code == 404
        assert response.json()["type"].endswith("unknown-sequence")
    for path in ("%2e", "%2E%2e", "%00", "%0A", "%C2%85", "%E2%80%AE", "x" * 3000):
        response = server.client.delete(f"/v1/maps/{map_id}/sequences/{path}")
        assert response.status_code == 422
        assert response.json()["type"].endswith("invalid-identifier")
