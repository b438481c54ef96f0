"""Cameras and their masks over HTTP: stored, applied to enrolled frames and queries, refused if they are invalid."""

from __future__ import annotations

import json
import re
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from tests.service.scenes import encoded, scene
from tests.service.server import Server, assert_problem

LOWER = 0.6
MASK: dict[str, Any] = {"polygons": [[[0, LOWER], [1, LOWER], [1, 1], [0, 1]]]}


INTRINSICS: dict[str, Any] = {
    "width": 640,
    "height": 480,
    "fx": 554.3,
    "fy": 554,
    "cx": 319.5,
    "cy": 239.5,
    "distortion_model": "plumb_bob",
    "distortion": [-0.28, 0.07, 0.0, 0.0, 0.0],
}


def behind(number: int, vehicle: int) -> bytes:
    """A scene whose lower part shows the vehicle of the camera."""
    pixels = scene(number)
    height, width = pixels.shape[:2]
    start = round(LOWER * height)
    pixels[start:] = cv2.resize(scene(vehicle), (width, height - start))
    return encoded(np.ascontiguousarray(pixels))


def put(client: httpx.Client, map_id: str, name: str, mask: Any) -> httpx.Response:
    return client.put(f"/v1/maps/{map_id}/cameras/{name}", json={"mask": mask})


def test_a_camera_is_made_replaced_listed_and_forgotten(client: httpx.Client, map_id: str) -> None:
    assert put(client, map_id, "front", None).status_code == 201
    replaced = put(client, map_id, "front", MASK)
    assert replaced.status_code == 200 and replaced.json()["mask"] == MASK
    put(client, map_id, "back", None)
    listed = client.get(f"/v1/maps/{map_id}/cameras").json()
    assert [camera["name"] for camera in listed["items"]] == ["back", "front"] and listed["next_cursor"] is None
    assert client.get(f"/v1/maps/{map_id}/cameras/front").json()["mask"] == MASK
    assert client.delete(f"/v1/maps/{map_id}/cameras/front").status_code == 204
    for method in ("GET", "DELETE"):
        gone = client.request(method, f"/v1/maps/{map_id}/cameras/front")
        assert_problem(gone, 404, "unknown-camera")


@pytest.mark.thorough
def test_the_mask_is_applied_at_enrolment_and_at_query(server: Server, map_id: str) -> None:
    put(server.client, map_id, "front", MASK)
    for number in range(8):
        enrolled = server.enrol(map_id, f"p{number}", behind(number, vehicle=50), camera="front")
        assert enrolled.status_code == 201 and enrolled.json()["camera"] == "front"
    # Another vehicle: without the mask it is another picture, with it the same place.
    with_mask = server.query(map_id, behind(3, vehicle=60), camera="front", verify="never")
    assert with_mask["matches"][0]["place"]["id"] == "p3"
    without = server.query(map_id, behind(3, vehicle=60), verify="never")
    assert with_mask["score"] > without["score"] + 0.03
    same = server.query(map_id, behind(3, vehicle=50), camera="front", verify="never")
    assert same["score"] == pytest.approx(with_mask["score"], abs=0.02)


def test_the_same_bytes_under_another_mask_are_encoded_again(server: Server, map_id: str) -> None:
    put(server.client, map_id, "front", MASK)
    put(server.client, map_id, "plain", None)
    frame = behind(1, vehicle=50)
    assert server.enrol(map_id, "p", frame).json()["change"] == "created"
    # A camera without a mask changes a field, one with a mask the descriptor.
    assert server.enrol(map_id, "p", frame, camera="plain").json()["change"] == "updated"
    assert server.enrol(map_id, "p", frame, camera="front").json()["change"] == "replaced"
    assert server.enrol(map_id, "p", frame, camera="front").json()["change"] == "unchanged"
    wider = {"polygons": [[[0, 0.5], [1, 0.5], [1, 1], [0, 1]]]}
    put(server.client, map_id, "front", wider)
    assert server.enrol(map_id, "p", frame, camera="front").json()["change"] == "replaced"


def test_a_batch_names_the_camera_of_each_frame(server: Server, map_id: str) -> None:
    put(server.client, map_id, "front", MASK)
    places = [
        {"id": "a", "file": "one", "camera": "front"},
        {"id": "b", "file": "two"},
        {"id": "c", "file": "two", "camera": "back"},
    ]
    files: dict[str, Any] = {
        "places": (None, json.dumps(places), "application/json"),
        "one": ("one.jpg", behind(1, 50), "image/jpeg"),
        "two": ("two.jpg", behind(2, 50), "image/jpeg"),
    }
    enrolled = server.client.post(f"/v1/maps/{map_id}/places", files=files)
    assert enrolled.status_code == 200, enrolled.text
    items = enrolled.json()["items"]
    assert [item["status"] for item in items] == [201, 201, 404]
    assert [item["place"]["camera"] for item in items[:2]] == ["front", None]
    assert items[2]["problem"]["type"].endswith("unknown-camera")
    answers = server.client.post(
        f"/v1/maps/{map_id}/query:batch",
        params={"camera": "front"},
        files={"f": ("f.jpg", behind(1, 60), "image/jpeg")},
    ).json()
    assert answers["items"][0]["answer"]["matches"][0]["place"]["id"] == "a"


def test_an_unknown_camera_is_refused(server: Server, map_id: str) -> None:
    refused = server.enrol(map_id, "p", behind(1, 50), camera="front")
    assert_problem(refused, 404, "unknown-camera")
    url = f"/v1/maps/{map_id}/query"
    asked = server.client.post(
        url, params={"camera": "front"}, content=behind(1, 50), headers={"Content-Type": "image/jpeg"}
    )
    assert_problem(asked, 404, "unknown-camera")
    assert server.client.get(f"/v1/maps/{map_id}").json()["places"] == 0


def test_the_camera_of_a_place_cannot_be_patched(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p", behind(1, 50))
    patched = server.client.patch(f"/v1/maps/{map_id}/places/p", json={"camera": "front"})
    assert_problem(patched, 422, "invalid-request")


@pytest.mark.parametrize(
    "mask",
    [
        {"polygons": []},
        {"polygons": [[[0, 0], [1, 1]]]},
        {"polygons": [[[0, 0], [2, 0], [1, 1]]]},
        {"polygons": [[[0, 0], [1, 0], [1, 1], [0, 1]]]},
        {"polygons": [[[0, 0], [1, 0], [1, 0.5]]], "colour": "red"},
        "everything",
    ],
)
def test_a_bad_mask_is_refused_and_nothing_is_stored(client: httpx.Client, map_id: str, mask: Any) -> None:
    assert_problem(put(client, map_id, "front", mask), 422, "invalid-request")
    assert client.get(f"/v1/maps/{map_id}/cameras").json()["items"] == []


def test_a_camera_keeps_its_intrinsics(client: httpx.Client, map_id: str) -> None:
    path = f"/v1/maps/{map_id}/cameras/front"
    made = client.put(path, json={"mask": MASK, "intrinsics": INTRINSICS})
    assert made.status_code == 201, made.text
    shown = client.get(path).json()
    assert (shown["mask"], shown["intrinsics"]) == (MASK, INTRINSICS)
    assert client.put(path, json={"mask": MASK}).json()["intrinsics"] is None


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"fx": 0}, "fx"),
        ({"fy": -500}, "fy"),
        ({"fx": 1e-3}, "fx"),
        ({"fx": 554, "fy": 60}, "factor of 4"),
        ({"cx": 700}, "principal point"),
        ({"cy": -3}, "principal point"),
        ({"cx": "middle"}, "cx"),
        ({"fx": None}, "fx"),
        ({"width": 0}, "width"),
        ({"distortion": [0.1]}, "coefficients"),
        ({"distortion": [-5, 0, 0, 0, 0]}, "distortion"),
        ({"distortion": [1e9, 0, 0, 0, 0]}, "distortion"),
        ({"distortion": [0.0] * 1000}, "distortion"),
        ({"distortion_model": "wavy"}, "distortion_model"),
        ({"distortion_model": "none"}, "coefficients"),
        ({"skew": 0.1}, "skew"),
    ],
)
def test_impossible_intrinsics_are_refused_and_nothing_is_stored(
    client: httpx.Client, map_id: str, change: dict[str, Any], told: str
) -> None:
    path = f"/v1/maps/{map_id}/cameras/front"
    refused = client.put(path, json={"intrinsics": INTRINSICS | change})
    assert_problem(refused, 422, "invalid-request")
    assert told in refused.text
    assert_problem(client.get(path), 404, "unknown-camera")


def deep(seed: int, low: int, step: int) -> bytes:
    """A scene in 16 bits, from ``low`` on in steps of ``step``."""
    grey = cv2.cvtColor(scene(seed), cv2.COLOR_BGR2GRAY)
    return encoded((grey.astype(np.uint16) * step + low), ".png")


@pytest.mark.parametrize(
    ("low", "step", "said"),
    [(0, 4, r"its values reach only \d+ of 65535"), (20_000, 8, r"its values lie between 2\d+ and 2\d+ of 65535")],
)
def test_frames_of_16_bits_are_scaled_by_the_range_of_their_camera(
    server: Server, map_id: str, low: int, step: int, said: str
) -> None:
    path = f"/v1/maps/{map_id}/cameras/deep"
    dark = assert_problem(server.enrol(map_id, "dark", deep(1, low, step)), 422, "no-regions")
    assert re.search(said, dark["detail"]) and "value_range" in dark["detail"]
    assert_problem(server.client.put(path, json={"value_range": [low, low]}), 422, "invalid-request")
    made = server.client.put(path, json={"value_range": [low, low + 255 * step]})
    assert made.status_code == 201 and made.json()["value_range"] == [low, low + 255 * step], made.text
    for seed in (1, 2):
        assert server.enrol(map_id, f"p{seed}", deep(seed, low, step), camera="deep").status_code == 201
    grey = encoded(cv2.cvtColor(scene(2), cv2.COLOR_BGR2GRAY), ".png")
    for answer in (server.query(map_id, deep(2, low, step), camera="deep"), server.query(map_id, grey, camera="deep")):
        assert answer["matches"][0]["place"]["id"] == "p2" and answer["matches"][0]["score"] > 0.99
    blank = server.query(map_id, deep(2, low, step))
    assert (blank["verdict"], blank["reason"]) == ("unknown", "few-values")
    assert server.query(map_id, encoded(np.zeros((64, 64), np.uint8), ".png"))["reason"] == "no-regions"


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999"])
def test_intrinsics_are_finite(client: httpx.Client, map_id: str, number: str) -> None:
    body = json.dumps({"intrinsics": INTRINSICS}).replace("554.3", number)
    refused = client.put(f"/v1/maps/{map_id}/cameras/front", content=body, headers={"Content-Type": "application/json"})
    assert refused.status_code in (400, 422), refused.text
    assert client.get(f"/v1/maps/{map_id}/cameras").json()["items"] == []


@pytest.mark.thorough
def test_a_map_has_a_limit_of_cameras(client: httpx.Client, map_id: str) -> None:
    for number in range(256):
        assert put(client, map_id, f"c{number}", None).status_code == 201
    assert_problem(put(client, map_id, "one-more", None), 422, "invalid-field")
    assert put(client, map_id, "c7", MASK).status_code == 200


@pytest.mark.parametrize("name", ["-front", "a" * 65, "fr:ont"])
def test_a_camera_needs_a_name_of_the_form(client: httpx.Client, map_id: str, name: str) -> None:
    assert_problem(put(client, map_id, name, None), 422, "invalid-request")
