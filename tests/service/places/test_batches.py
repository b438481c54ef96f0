"""Many frames in one request: a bad frame fails alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import httpx
import pytest

from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_item_problem, assert_problem


def send(server: Server, map_id: str, places: object, files: Mapping[str, bytes], **options: Any) -> httpx.Response:
    """One multipart request."""
    text = places if isinstance(places, str) else json.dumps(places)
    parts = {name: (f"{name}.jpg", data, "image/jpeg") for name, data in files.items()}
    return server.client.post(f"/v1/maps/{map_id}/places", data={"places": text}, files=parts, **options)


@pytest.mark.thorough
def test_good_frames_are_stored_and_bad_ones_reported(server: Server, map_id: str) -> None:
    places: list[Any] = [
        {"id": "good-1", "file": "a", "x": 1, "y": 2, "heading": 3, "sequence": "s", "metadata": {"n": 1}},
        {"id": "cut", "file": "cut"},
        {"id": "good-2", "file": "b", "x": 48, "y": 2, "timestamp": "2026-11-20T10:00:00Z"},
        {"id": "not an id", "file": "a"},
        {"id": "no-file", "file": "absent"},
        {"id": "half-pose", "file": "a", "x": 1},
        {"id": "nan", "file": "a", "x": float("nan"), "y": 0},
        {"id": "odd-field", "file": "a", "colour": "red"},
        {"id": "bad-metadata", "file": "a", "metadata": "{}"},
        {"id": "infinite", "file": "a", "metadata": {"a": float("inf")}},
        {"file": "a"},
        "not an object",
        {"id": "good-1", "file": "b"},
        {"id": "text", "file": "text"},
        {"id": "empty", "file": "empty"},
        {"id": "tiny", "file": "tiny"},
        {"id": "good-3", "file": "a"},
        {"id": "other-kind", "file": "a", "latitude": 48, "longitude": 2},
    ]
    files = {
        "a": jpeg(1),
        "b": jpeg(2),
        "cut": jpeg(3)[:2000],
        "text": b"hello, robot",
        "empty": b"",
        "tiny": encoded(scene(1)[:1, :1]),
    }
    response = send(server, map_id, places, files)
    assert response.status_code == 200, response.text
    items = response.json()["items"]
    assert len(items) == len(places)
    by_position = dict(enumerate(items))
    for position in (0, 2, 16):
        item = by_position.pop(position)
        assert item["status"] == 201 and item["change"] == "created" and "problem" not in item
        assert item["id"] == item["place"]["id"] == places[position]["id"]
    expected = {
        1: (422, "truncated-image"),
        3: (422, "invalid-identifier"),
        4: (422, "invalid-request"),
        5: (422, "invalid-request"),
        6: (422, "invalid-request"),
        7: (422, "invalid-request"),
        8: (422, "invalid-request"),
        9: (422, "invalid-request"),
        10: (422, "invalid-request"),
        11: (422, "invalid-request"),
        12: (422, "invalid-request"),
        13: (422, "not-an-image"),
        14: (422, "empty-image"),
        15: (422, "image-too-small"),
        17: (409, "mixed-coordinates"),
    }
    for position, (status, slug) in expected.items():
        assert_item_problem(by_position[position], status, slug)
        assert "place" not in by_position[position]
    assert set(server.places(map_id)) == {"good-1", "good-2", "good-3"}
    place = server.client.get(f"/v1/maps/{map_id}/places/good-1").json()
    assert place["pose"] == {"x": 1.0, "y": 2.0, "heading": 3.0} and place["metadata"] == {"n": 1}
    assert server.query(map_id, jpeg(2))["matches"][0]["place"]["id"] == "good-2"


def test_a_batch_can_be_repeated(server: Server, map_id: str) -> None:
    places = [{"id": f"p{number}", "file": f"f{number}", "sequence": "s"} for number in range(3)]
    files = {f"f{number}": jpeg(number) for number in range(3)}
    first, again = (send(server, map_id, places, files).json()["items"] for _ in range(2))
    assert [item["status"] for item in first] == [201] * 3
    assert [(item["status"], item["change"]) for item in again] == [(200, "unchanged")] * 3
    places[0]["sequence"] = "t"
    files["f1"] = jpeg(9)
    third = send(server, map_id, places, files).json()["items"]
    assert [item["change"] for item in third] == ["updated", "replaced", "unchanged"]
    assert len(server.places(map_id)) == 3


@pytest.mark.parametrize(
    ("places", "status", "slug"),
    [
        ("{", 400, "malformed-body"),
        ("{}", 422, "invalid-request"),
        ("[]", 422, "invalid-request"),
        ("null", 422, "invalid-request"),
        ("[" * 50_000, 400, "malformed-body"),
        (json.dumps([{"id": "p", "file": "other"}]), 422, "invalid-request"),
        (json.dumps([{"id": f"p{n}", "file": "a"} for n in range(257)]), 422, "invalid-request"),
    ],
)
def test_malformed_batches_are_refused(server: Server, map_id: str, places: str, status: int, slug: str) -> None:
    assert_problem(send(server, map_id, places, {"a": jpeg(1)}), status, slug)
    assert set(server.places(map_id)) == set()


def test_a_batch_needs_its_list_and_its_form(server: Server, map_id: str) -> None:
    path = f"/v1/maps/{map_id}/places"
    assert_problem(server.client.post(path, files={"a": ("a.jpg", jpeg(1))}), 422, "invalid-request")
    twice = [("places", (None, "[]")), ("places", (None, "[]"))]
    assert_problem(server.client.post(path, files=twice), 422, "invalid-request")
    raw = server.client.post(path, content=jpeg(1), headers={"Content-Type": "image/jpeg"})
    assert_problem(raw, 415, "unsupported-media-type")
    cut = b'--b\r\nContent-Disposition: form-data; name="places"\r\n\r\n[]'
    headers = {"Content-Type": "multipart/form-data; boundary=b"}
    assert_problem(server.client.post(path, content=cut, headers=headers), 400, "malformed-body")
    headers = {"Content-Type": "multipart/form-data"}
    assert_problem(server.client.post(path, content=cut, headers=headers), 400, "malformed-body")


def test_a_batch_for_a_wrong_encoder_or_map(server: Server, map_id: str) -> None:
    places, files = [{"id": "p", "file": "a"}], {"a": jpeg(1)}
    wrong = send(server, map_id, places, files, params={"encoder": "region-vlad"})
    assert_problem(wrong, 409, "wrong-encoder")
    assert_problem(send(server, "nowhere", places, files), 404, "unknown-map")
    assert set(server.places(map_id)) == set()


def test_the_list_may_be_a_file_itself(server: Server, map_id: str) -> None:
    parts: list[tuple[str, tuple[str, str | bytes, str]]] = [
        ("frame", ("f.webp", encoded(scene(4), ".webp"), "image/webp")),
        ("places", ("places.json", json.dumps([{"id": "p", "file": "frame"}]), "application/json")),
    ]
    response = server.client.post(f"/v1/maps/{map_id}/places", files=parts)
    assert response.json()["items"][0]["status"] == 201


def test_one_frame_over_the_limit_fails_alone(tight_server: Server, tight_map: str) -> None:
    large = encoded(scene(1, 640, 480), ".png")
    assert 60_000 < len(large) < 1_000_000
    wide = encoded(scene(1, 1000, 500) // 64 * 64, ".jpg", 30)
    assert len(wide) < 60_000
    places = [{"id": "large", "file": "large"}, {"id": "wide", "file": "wide"}, {"id": "good", "file": "good"}]
    fitting = {"large": large[:70_000], "wide": wide, "good": encoded(scene(1), quality=60)}
    items = send(tight_server, tight_map, places, fitting).json()["items"]
    assert_item_problem(items[0], 413, "image-too-large")
    assert_item_problem(items[1], 413, "too-many-pixels")
    assert items[2]["status"] == 201


def test_a_batch_over_its_limits(tight_server: Server, tight_map: str) -> None:
    many = [{"id": f"p{number}", "file": "a"} for number in range(4)]
    small = encoded(scene(1, 64, 64))
    assert_problem(send(tight_server, tight_map, many, {"a": small}), 422, "invalid-request")
    heavy = {f"f{number}": b"\xff\xd8" + b"x" * 59_000 for number in range(8)}
    assert_problem(send(tight_server, tight_map, many, heavy), 413, "body-too-large")
    files = [("f", ("f.jpg", small, "image/jpeg"))] * 4
    queried = tight_server.client.post(f"/v1/maps/{tight_map}/query:batch", files=files)
    assert "4 file parts; the limit is 3" in assert_problem(queried, 422, "invalid-request")["detail"]
    crowd = {f"f{number}": b"x" for number in range(60)}
    assert_problem(send(tight_server, tight_map, many, crowd), 413, "body-too-large")
    assert set(tight_server.places(tight_map)) == set()


@pytest.mark.thorough
def test_many_queries_at_once(server: Server, traverse: str) -> None:
    files = {f"f{number}": encoded(seen_again(scene(number))) for number in range(4)}
    files["bad"] = b"no image"
    parts = {name: (name, data, "image/jpeg") for name, data in files.items()}
    response = server.client.post(f"/v1/maps/{traverse}/query:batch", params={"k": 2}, files=parts)
    assert response.status_code == 200, response.text
    items = response.json()["items"]
    assert [item["file"] for item in items] == list(files)
    for number, item in enumerate(items[:4]):
        alone = server.query(traverse, files[f"f{number}"], k=2)
        assert item["status"] == 200 and "problem" not in item
        assert [match["place"] for match in item["answer"]["matches"]] == [match["place"] for match in alone["matches"]]
        assert item["answer"]["verdict"] == alone["verdict"]
        assert item["answer"]["score"] == pytest.approx(alone["score"], abs=1e-6)
    assert_item_problem(items[4], 422, "not-an-image")


def test_malformed_batches_of_queries_are_refused(server: Server, traverse: str) -> None:
    path = f"/v1/maps/{traverse}/query:batch"
    assert_problem(server.client.post(path, files={"k": (None, b"3")}), 422, "invalid-request")
    assert_problem(
        server.client.post(path, content=jpeg(1), headers={"Content-Type": "image/jpeg"}), 415, "unsupported-media-type"
    )
    files = {"a": ("a.jpg", jpeg(1))}
    assert_problem(server.client.post(path, params={"k": 0}, files=files), 422, "invalid-request")
    assert_problem(server.client.post(path, params={"encoder": "coarse"}, files=files), 409, "wrong-encoder")
    assert_problem(server.client.post("/v1/maps/nowhere/query:batch", files=files), 404, "unknown-map")
