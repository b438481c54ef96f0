"""A traverse is compared with its map before its frames are sent; frames of other places replace nothing by chance."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import pytest

from service.places.comparison import TakenPlace, taken_text
from tests.service.places.test_batches import send
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem


def digest(number: int) -> str:
    return hashlib.sha256(jpeg(number)).hexdigest()


@pytest.fixture(scope="module")
def compared(server: Server) -> str:
    """A map whose traverses day and day~2 have two places each; two more belong to night and to none."""
    server.create_map("compared")
    for place_id, number, sequence in (
        ("a0", 1, "day"), ("a1", 2, "day"), ("b0", 3, "day~2"), ("b1", 4, "day~2"), ("n0", 5, "night"), ("z0", 6, None),
    ):  # fmt: skip
        server.enrol("compared", place_id, jpeg(number), **({} if sequence is None else {"sequence": sequence}))
    return "compared"


@pytest.mark.parametrize(
    ("frames", "sequence", "named", "name", "free", "known", "taken"),
    [
        pytest.param({"c0": None}, "dusk", False, "dusk", "dusk", 0, {}, id="nothing is there"),
        pytest.param({"c0": None}, "day", False, "day~3", "day~3", 0, {}, id="the name is made unique"),
        pytest.param({"c0": None}, "night~2", False, "night~2", "night~2", 0, {}, id="a free name with a number"),
        pytest.param({"c0": None}, "day~2", False, "day~3", "day~3", 0, {}, id="a taken name with a number"),
        pytest.param({"c0": None}, "day", True, "day", "day~3", 0, {}, id="a chosen name stays"),
        pytest.param({"a0": None}, "day", True, "day", "day~3", 0, {"a0": None}, id="ids alone tell it"),
        pytest.param({"a0": 1, "a1": 2, "c0": None}, "day", False, "day", "day~3", 2, {}, id="it goes on"),
        pytest.param({"b0": 3, "b1": 4}, "day", False, "day~2", "day~3", 2, {}, id="it goes on in the second"),
        pytest.param({"a0": 9, "a1": 2}, "day", True, "day", "day~3", 1, {"a0": False}, id="one picture differs"),
        pytest.param({"n0": 5}, "day", False, "day~3", "day~3", 0, {"n0": True}, id="it is in another traverse"),
        pytest.param({"a0": 1, "b0": 3}, "day", True, "day", "day~3", 2, {}, id="segments belong to it"),
        pytest.param({"a0": 1}, "day~2", True, "day~2", "day~3", 0, {"a0": True}, id="it is in the first segment"),
        pytest.param({"z0": 6, "n0": 5}, None, True, None, None, 1, {"n0": True}, id="without a traverse"),
    ],
)
def test_what_a_map_has_of_a_traverse(
    server: Server, compared: str, frames: dict[str, int | None], sequence: str | None, named: bool, name: str | None,
    free: str | None, known: int, taken: dict[str, bool | None],
) -> None:  # fmt: skip
    places = [{"id": one, "sha256": None if number is None else digest(number)} for one, number in frames.items()]
    order = {"places": places, "sequence": sequence, "named": named}
    answer = server.client.post(f"/v1/maps/{compared}/places:compare", json=order)
    assert answer.status_code == 200, answer.text
    told = answer.json()
    assert (told["sequence"], told["free"], told["known"]) == (name, free, known)
    assert {one["id"]: one["same"] for one in told["taken"]} == taken


def test_a_frame_under_another_mask_is_another_frame(server: Server, map_id: str) -> None:
    mask = {"polygons": [[[0, 0], [0.2, 0], [0, 0.2]]]}
    assert server.client.put(f"/v1/maps/{map_id}/cameras/front", json={"mask": mask, "intrinsics": None}).is_success
    server.enrol(map_id, "a", jpeg(1), sequence="day", camera="front")
    path, order = f"/v1/maps/{map_id}/places:compare", {"places": [{"id": "a", "sha256": digest(1)}], "sequence": "day"}
    assert server.client.post(path, json=order | {"camera": "front"}).json()["known"] == 1
    assert server.client.post(path, json=order).json()["known"] == 0
    assert_problem(server.client.post(path, json=order | {"camera": "rear"}), 404, "unknown-camera")


@pytest.mark.parametrize(
    ("enrolled", "compared_by", "number", "picture", "text"),
    [
        pytest.param(None, "ranged", 1, True, "with these pictures, but by another", id="a camera now"),
        pytest.param("masked", None, 1, True, "with these pictures, but by another", id="no camera now"),
        pytest.param("masked", "ranged", 1, True, "with these pictures, but by another", id="another camera"),
        pytest.param(None, "ranged", 2, False, "with other pictures.", id="another picture"),
        pytest.param("masked", None, 2, None, "with other pictures, or these by another", id="another mask then"),
    ],
)
def test_the_same_picture_by_another_camera_is_told_from_another_picture(
    server: Server, map_id: str, enrolled: str | None, compared_by: str | None, number: int, picture: bool | None,
    text: str,
) -> None:  # fmt: skip
    cameras = {"masked": {"mask": {"polygons": [[[0, 0], [0.2, 0], [0, 0.2]]]}}, "ranged": {"value_range": [0, 1020]}}
    for name, camera in cameras.items():
        assert server.client.put(f"/v1/maps/{map_id}/cameras/{name}", json=camera).is_success
    server.enrol(map_id, "a", jpeg(1), sequence="day", **({} if enrolled is None else {"camera": enrolled}))
    order = {"places": [{"id": "a", "sha256": digest(number)}], "sequence": "day", "camera": compared_by}
    (one,) = server.client.post(f"/v1/maps/{map_id}/places:compare", json=order).json()["taken"]
    assert (one["same"], one["picture"]) == (False, picture)
    assert text in taken_text([TakenPlace.model_validate(one)], 1)


@pytest.mark.parametrize(
    ("there", "coordinates", "refused"),
    [
        ({"x": 1, "y": 2}, "geographic", True),
        ({"x": 1, "y": 2}, "metric", False),
        ({"latitude": 49, "longitude": 8}, "metric", True),
        ({"latitude": 49, "longitude": 8}, None, False),
        ({}, "geographic", False),
    ],
)
def test_poses_of_the_other_kind_are_refused_before_anything_is_sent(
    server: Server, map_id: str, there: dict[str, float], coordinates: str | None, refused: bool
) -> None:
    server.enrol(map_id, "a", jpeg(1), **there)
    order = {"places": [{"id": "b"}], "sequence": "day", "coordinates": coordinates}
    answer = server.client.post(f"/v1/maps/{map_id}/places:compare", json=order)
    if refused:
        assert_problem(answer, 409, "mixed-coordinates")
    else:
        assert answer.status_code == 200, answer.text


def test_nothing_is_replaced_unless_it_is_to_be(server: Server, map_id: str) -> None:
    def changes(files: dict[str, bytes], **params: Any) -> list[str]:
        entries = [{"id": name, "file": name} for name in files]
        items = send(server, map_id, entries, files, params=params).json()["items"]
        return [one.get("change") or one["problem"]["type"].rpartition(":")[2] for one in items]

    assert changes({"a": jpeg(1), "b": jpeg(2)}) == ["created", "created"]
    again = {"a": jpeg(1), "b": jpeg(3), "c": jpeg(4)}
    assert changes(again, replace=False) == ["unchanged", "places-taken", "created"]
    form = {"places": (None, json.dumps([{"id": "b", "sha256": digest(3)}]), "application/json")}
    answer = server.client.post(f"/v1/maps/{map_id}/places", params={"replace": False}, files=form)
    (item,) = answer.json()["items"]
    assert item["status"] == 409 and item["problem"]["type"].endswith(":places-taken")
    assert changes(again) == ["unchanged", "replaced", "unchanged"]
