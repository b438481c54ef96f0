"""Places over HTTP: enrol, list, read, edit and delete them, and fetch their thumbnails."""

from __future__ import annotations

import json
import math
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from tests.service.scenes import blank, encoded, jpeg, scene
from tests.service.server import Server, assert_problem


def test_enrolling_one_frame(server: Server, map_id: str) -> None:
    response = server.enrol(
        map_id,
        "p7",
        jpeg(7),
        x=1.5,
        y=2,
        heading=90,
        sequence="monday",
        timestamp="2026-11-20T10:00:00Z",
        metadata={"camera": "front", "naïve": ["✓", None, 1.5]},
    )
    assert response.status_code == 201
    made = response.json()
    assert made["id"] == "p7" and made["change"] == "created" and made["regions"] > 0
    assert made["pose"] == {"x": 1.5, "y": 2.0, "heading": 90.0}
    assert made["timestamp"] == "2026-11-20T10:00:00Z" and made["sequence"] == "monday"
    assert made["metadata"] == {"camera": "front", "naïve": ["✓", None, 1.5]}
    assert {"decode", "forward", "regions", "vlad", "total"} <= set(made["milliseconds"])
    read = server.client.get(f"/v1/maps/{map_id}/places/p7").json()
    assert read == {name: value for name, value in made.items() if name in read}
    assert server.client.get(f"/v1/maps/{map_id}").json()["places"] == 1


def test_a_put_replaces_the_whole_place(server: Server, map_id: str) -> None:
    first = server.enrol(map_id, "p", jpeg(1), x=1, y=2, sequence="a", metadata={"k": 1}).json()
    assert server.enrol(map_id, "p", jpeg(1), x=1, y=2, sequence="a", metadata={"k": 1}).json()["change"] == "unchanged"
    response = server.enrol(map_id, "p", jpeg(1), heading=5, latitude=48.8, longitude=2.3)
    second = response.json()
    assert (response.status_code, second["change"]) == (200, "updated")
    assert second["pose"] == {"latitude": 48.8, "longitude": 2.3, "heading": 5.0}
    assert (second["sequence"], second["metadata"], second["timestamp"]) == (None, {}, None), "left out is cleared"
    assert "forward" not in second["milliseconds"], "the same bytes are not encoded again"
    assert second["created_at"] == first["created_at"]
    third = server.enrol(map_id, "p", jpeg(2)).json()
    assert third["change"] == "replaced" and third["pose"] is None
    assert "forward" in third["milliseconds"]
    assert server.query(map_id, jpeg(2))["score"] > 2 * server.query(map_id, jpeg(1))["score"], "jpeg(1) is gone"


def test_a_form_holds_the_same_parameters(server: Server, map_id: str) -> None:
    path = f"/v1/maps/{map_id}/places/form"
    fields = {"x": "1", "y": "2", "metadata": '{"a": 1}', "sequence": "söndag"}
    response = server.client.put(path, data=fields, files={"image": ("f.jpg", jpeg(3), "image/jpeg")})
    assert response.status_code == 201
    assert response.json()["pose"] == {"x": 1.0, "y": 2.0} and response.json()["sequence"] == "söndag"
    mixed = server.client.put(path, params={"x": 5}, data={"y": "2"}, files={"any": ("f.bin", jpeg(3))})
    assert mixed.json()["pose"] == {"x": 5.0, "y": 2.0}


def test_a_form_may_not_contradict_the_query_string(server: Server, map_id: str) -> None:
    path = f"/v1/maps/{map_id}/places/form"
    files = {"image": ("f.jpg", jpeg(3), "image/jpeg")}
    assert_problem(
        server.client.put(path, params={"x": 1}, data={"x": "1", "y": "1"}, files=files), 422, "invalid-request"
    )
    assert_problem(server.client.put(path, data={"colour": "red"}, files=files), 422, "invalid-request")
    two = [("a", ("a.jpg", jpeg(1), "image/jpeg")), ("b", ("b.jpg", jpeg(2), "image/jpeg"))]
    assert_problem(server.client.put(path, files=two), 422, "invalid-request")
    assert_problem(server.client.put(path, data={"x": "1"}, files=[("x", (None, b"2"))]), 422, "invalid-request")


@pytest.mark.thorough
@pytest.mark.parametrize(
    "parameters",
    [
        {"x": 1},
        {"y": 1},
        {"z": 1},
        {"x": 1, "z": 1},
        {"heading": 90},
        {"latitude": 1},
        {"x": 1, "y": 1, "latitude": 1, "longitude": 1},
        {"latitude": 91, "longitude": 0},
        {"latitude": 0, "longitude": -181},
        {"x": "nan", "y": 1},
        {"x": "inf", "y": 1},
        {"x": "1e400", "y": 1},
        {"x": 1e12, "y": 1},
        {"x": "east", "y": 1},
        {"x": "", "y": 1},
        {"x": 1, "y": 1, "heading": 400},
        {"x": 1, "y": 1, "heading": "nan"},
        {"timestamp": "yesterday"},
        {"timestamp": "0001-01-01T00:00:00+14:00"},
        {"timestamp": "9999-12-31T23:59:59-14:00"},
        {"timestamp": "99999999999999999999"},
        {"sequence": ""},
        {"sequence": "a/b"},
        {"sequence": "a\x00b"},
        {"sequence": "s" * 129},
        {"metadata": "{"},
        {"metadata": "[1]"},
        {"metadata": "7"},
        {"metadata": ""},
        {"metadata": '{"a": NaN}'},
        {"metadata": '{"a": 1e999}'},
        {"metadata": '{"a": "\\ud800"}'},
        {"metadata": '{"a":' * 2000 + "1" + "}" * 2000},
        {"metadata": json.dumps({"a": "x" * 17_000})},
        {"pose": "1,2"},
        {"colour": "red"},
    ],
)
def test_parameters_that_do_not_fit(server: Server, map_id: str, parameters: dict[str, str]) -> None:
    assert_problem(server.enrol(map_id, "p", jpeg(1), **parameters), 422, "invalid-request")
    assert server.client.get(f"/v1/maps/{map_id}").json()["places"] == 0


def test_a_parameter_may_not_be_repeated(server: Server, map_id: str) -> None:
    headers = {"Content-Type": "image/jpeg"}
    response = server.client.put(f"/v1/maps/{map_id}/places/p?x=1&x=2&y=3", content=jpeg(1), headers=headers)
    assert_problem(response, 422, "invalid-request")


@pytest.mark.parametrize("name", [".p", "-p", "p%20q", "a" * 129, "p%00", "%C3%A9", "p%0A", "p:q"])
def test_bad_place_names(server: Server, map_id: str, name: str) -> None:
    response = server.client.put(
        f"/v1/maps/{map_id}/places/{name}", content=jpeg(1), headers={"Content-Type": "image/jpeg"}
    )
    assert response.status_code == 422
    assert response.json()["type"].endswith("invalid-identifier")


@pytest.mark.parametrize("name", ["P", "0", "a" * 128, "a.b_c~d-e", "Frame~001.jpg"])
def test_good_place_names(server: Server, map_id: str, name: str) -> None:
    assert server.enrol(map_id, name, jpeg(1)).json()["id"] == name


def test_a_wrong_encoder_is_refused(server: Server, map_id: str) -> None:
    identity = server.client.get(f"/v1/maps/{map_id}").json()["encoder"]
    for right in (identity, identity.split("@")[0]):
        assert server.enrol(map_id, "p", jpeg(1), encoder=right).status_code in (200, 201)
    for wrong in ("region-vlad", "m-region-vlad@" + "0" * 64, "absent", identity + "0"):
        assert_problem(server.enrol(map_id, "q", jpeg(2), encoder=wrong), 409, "wrong-encoder")
    assert_problem(server.client.get(f"/v1/maps/{map_id}/places/q"), 404, "unknown-place")


def test_a_frame_without_regions_is_not_enrolled(server: Server) -> None:
    server.create_map("blank-places")
    assert_problem(server.enrol("blank-places", "dark", encoded(blank())), 422, "no-regions")
    assert server.enrol("blank-places", "light", jpeg(1)).status_code == 201


def test_sixteen_pixels_are_enough_and_fifteen_are_not(server: Server, map_id: str) -> None:
    assert server.enrol(map_id, "p", encoded(scene(1)[:16, :16], ".png")).status_code == 201
    assert_problem(server.enrol(map_id, "q", encoded(scene(1)[:200, :15], ".png")), 422, "image-too-small")


def test_listing_and_its_pages(server: Server, map_id: str) -> None:
    for number in range(5):
        server.enrol(map_id, f"p{number}", jpeg(number), sequence="odd" if number % 2 else "even")
    client, path = server.client, f"/v1/maps/{map_id}/places"
    seen: list[str] = []
    cursor: dict[str, str] = {}
    while True:
        page = client.get(path, params={"limit": 2, **cursor}).json()
        seen += [item["id"] for item in page["items"]]
        if page["next_cursor"] is None:
            break
        cursor = {"cursor": page["next_cursor"]}
    assert seen == ["p0", "p1", "p2", "p3", "p4"]
    odd = client.get(path, params={"sequence": "odd"}).json()
    assert [item["id"] for item in odd["items"]] == ["p1", "p3"] and odd["next_cursor"] is None
    assert client.get(path, params={"sequence": "none such"}).json()["items"] == []


def test_a_level_and_the_accuracy_of_a_pose(server: Server, map_id: str) -> None:
    exact = {"metres": 0.5, "degrees": 2.0}
    made = server.enrol(map_id, "p", jpeg(1), x=1, y=2, level=2, accuracy_metres=0.5, accuracy_degrees=2).json()
    assert (made["level"], made["pose_accuracy"]) == ("2", exact)
    path, places = f"/v1/maps/{map_id}/places/p", f"/v1/maps/{map_id}/places"
    batch = [{"id": "q", "file": "q", "level": -1, "accuracy_metres": 3}, {"id": "r", "file": "r", "level": "EG"}]
    form: dict[str, Any] = {"places": (None, json.dumps(batch)), **{name: (name, jpeg(2)) for name in "qr"}}
    sent = server.client.post(f"{places}", files=form).json()["items"]
    assert [item["place"]["level"] for item in sent] == ["-1", "EG"]
    assert sent[0]["place"]["pose_accuracy"] == {"metres": 3.0, "degrees": None}
    assert [one["id"] for one in server.client.get(places, params={"level": "EG"}).json()["items"]] == ["r"]
    edited = server.client.patch(path, json={"level": 3, "pose_accuracy": {"metres": 1}}).json()
    assert (edited["level"], edited["pose_accuracy"]) == ("3", {"metres": 1.0, "degrees": 2.0})
    cleared = server.client.patch(path, json={"level": None, "pose_accuracy": None}).json()
    assert (cleared["level"], cleared["pose_accuracy"]) == (None, None)
    for wrong in ({"level": "a/b"}, {"level": "x" * 33}, {"accuracy_metres": 0}, {"accuracy_degrees": 2}):
        assert_problem(server.enrol(map_id, "s", jpeg(3), **wrong), 422, "invalid-request")
    for change in ({"level": 1.5}, {"level": True}, {"pose_accuracy": {"degrees": 2}}):
        assert_problem(server.client.patch(path, json=change), 422, "invalid-request")


def test_a_place_without_a_level_has_that_of_its_metadata(server: Server, map_id: str) -> None:
    path = f"/v1/maps/{map_id}/places/p"
    assert server.enrol(map_id, "p", jpeg(1), metadata={"floor": 2}).json()["level"] == "2"
    assert server.client.patch(path, json={"metadata": {"floor": 3}}).json()["level"] == "3", "it follows"
    assert server.client.patch(path, json={"level": "roof"}).json()["level"] == "roof"
    assert server.client.patch(path, json={"metadata": {"floor": 4}}).json()["level"] == "roof"
    assert server.client.patch(path, json={"level": None}).json()["level"] == "4"
    for metadata in ({"floor": [1]}, {"storey": True}, {"level": "x" * 40}, {"height": 3}):
        assert server.enrol(map_id, "q", jpeg(2), metadata=metadata).json()["level"] is None


def test_editing_is_a_merge_patch(server: Server, map_id: str) -> None:
    path = f"/v1/maps/{map_id}/places/p"
    server.enrol(map_id, "p", jpeg(1), x=1, y=2, sequence="a", metadata={"a": 1, "b": {"c": 2, "d": 3}})
    patch = {"pose": {"heading": 90}, "sequence": None, "metadata": {"a": None, "b": {"c": 5}, "e": "✓"}}
    edited = server.client.patch(path, json=patch).json()
    assert edited["pose"] == {"x": 1.0, "y": 2.0, "heading": 90.0}
    assert edited["sequence"] is None and edited["metadata"] == {"b": {"c": 5, "d": 3}, "e": "✓"}
    moved = server.client.patch(path, json={"pose": {"x": None, "y": None, "latitude": 1, "longitude": 2}}).json()
    assert moved["pose"] == {"latitude": 1.0, "longitude": 2.0, "heading": 90.0}
    cleared = server.client.patch(path, json={"pose": None, "metadata": None, "timestamp": "2026-01-01T00:00:00+01:00"})
    assert cleared.json()["pose"] is None and cleared.json()["metadata"] == {}
    assert cleared.json()["timestamp"] == "2025-12-31T23:00:00Z"
    assert server.client.get(path).json() == cleared.json()


@pytest.mark.thorough
@pytest.mark.parametrize(
    "changes",
    [
        {"pose": {"x": 1}},
        {"pose": {"speed": 1}},
        {"id": "q"},
        {"regions": 3},
        {"sequence": "a/b"},
        {"metadata": [1]},
        {"metadata": {"a": "x" * 17_000}},
        {"timestamp": "soon"},
        {"pose": {"x": 1e12, "y": 0}},
        7,
    ],
)
def test_edits_that_do_not_fit(server: Server, map_id: str, changes: object) -> None:
    path = f"/v1/maps/{map_id}/places/p"
    server.enrol(map_id, "p", jpeg(1))
    before = server.client.get(path).json()
    response = server.client.patch(path, json=changes)
    assert response.status_code == 422
    assert response.json()["type"].rpartition(":")[2] in ("invalid-request", "invalid-field")
    assert server.client.get(path).json() == before


def test_metadata_does_not_grow_past_its_limit_by_edits(server: Server, map_id: str) -> None:
    path = f"/v1/maps/{map_id}/places/p"
    server.enrol(map_id, "p", jpeg(1), metadata={"a": "x" * 9000})
    assert_problem(server.client.patch(path, json={"metadata": {"b": "y" * 9000}}), 422, "invalid-request")


def test_deleting_a_place(server: Server, map_id: str) -> None:
    path = f"/v1/maps/{map_id}/places/p"
    server.enrol(map_id, "p", jpeg(1))
    assert server.query(map_id, jpeg(1))["matches"]
    assert server.client.delete(path).status_code == 204
    assert server.query(map_id, jpeg(1))["matches"] == []
    for response in (server.client.delete(path), server.client.get(path), server.client.get(path + "/thumbnail")):
        assert_problem(response, 404, "unknown-place")
    assert_problem(server.client.patch(path, json={}), 404, "unknown-place")
    assert server.enrol(map_id, "p", jpeg(1)).status_code == 201


def test_thumbnails(server: Server) -> None:
    kept = {keep: f"keep-{keep}" for keep in ("none", "thumbnail", "image")}
    large = encoded(scene(1, 640, 480))
    for keep, name in kept.items():
        server.create_map(name, keep=keep)
        assert server.enrol(name, "p", large).json()["picture"] == keep
    for keep in ("thumbnail", "image"):
        response = server.client.get(f"/v1/maps/{kept[keep]}/places/p/thumbnail")
        assert response.headers["content-type"] == "image/jpeg"
        shown = cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_COLOR)
        assert shown is not None and max(shown.shape) == 320 and len(response.content) < len(large)
    assert_problem(server.client.get(f"/v1/maps/{kept['none']}/places/p/thumbnail"), 404, "no-thumbnail")


def test_headings_are_normalized_to_a_turn(server: Server, map_id: str) -> None:
    pose = server.enrol(map_id, "p", jpeg(1), x=0, y=0, heading=-90).json()["pose"]
    assert math.isclose(pose["heading"], 270)


def test_two_writers_of_one_place_leave_one_of_the_two(server: Server, map_id: str) -> None:
    from concurrent.futures import ThreadPoolExecutor

    server.enrol(map_id, "p", jpeg(0), sequence="s0")
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda n: server.enrol(map_id, "p", jpeg(n % 2), sequence=f"s{n % 2}"), range(16)))
    assert {answer.status_code for answer in answers} == {200}
    place = server.client.get(f"/v1/maps/{map_id}/places/p").json()
    shown = int(server.query(map_id, jpeg(1))["score"] > server.query(map_id, jpeg(0))["score"])
    assert place["sequence"] == f"s{shown}", "the fields are those that came with the picture"


def test_thumbnails_are_not_cached(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p", jpeg(1))
    response = server.client.get(f"/v1/maps/{map_id}/places/p/thumbnail")
    assert response.headers["cache-control"] == "no-cache"
    assert response.headers["x-content-type-options"] == "nosniff"


def test_answers_are_json_of_finite_numbers(client: httpx.Client, server: Server, map_id: str) -> None:
    server.enrol(map_id, "p", jpeg(1), x=1, y=2)
    assert "NaN" not in client.get(f"/v1/maps/{map_id}/places").text
