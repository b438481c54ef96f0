"""``placerec maps cameras``: the same commands on the data directory and over HTTP."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.service.commands.conftest import Placerec
from tests.service.server import Server

MASK = {"polygons": [[[0.0, 0.75], [1.0, 0.75], [1.0, 1.0], [0.0, 1.0]]]}
LENS = {
    "width": 640,
    "height": 480,
    "fx": 554.3125,
    "fy": 554.3125,
    "cx": 319.5,
    "cy": 239.5,
    "distortion_model": "plumb_bob",
    "distortion": [-0.28, 0.07, 0.0002, 0.0, 0.0],
}


def cells(shown: str) -> list[list[str]]:
    """The words of each line of a table."""
    return [line.split() for line in shown.splitlines()]


@pytest.mark.thorough
def test_a_camera_from_its_making_to_its_end(placerec: Placerec, where: list[str], tmp_path: Path) -> None:
    lab = f"cameras-{len(where)}"
    mask, lens, nothing = tmp_path / "mask.json", tmp_path / "lens.json", tmp_path / "nothing.json"
    mask.write_text(json.dumps(MASK))
    lens.write_text(json.dumps(LENS))
    nothing.write_text("null")
    placerec("maps", "create", lab, *where)
    put = ("maps", "cameras", "put", lab, "front", *where)

    def made(*words: object, stdin: str | None = None) -> list[object]:
        placerec(*put, *words, stdin=stdin)
        found = json.loads(placerec("maps", "cameras", "show", lab, "front", "--json", *where).stdout)
        assert found["name"] == "front"
        assert found["value_range"] == (values or None)
        return [found["mask"], found["intrinsics"]]

    values: list[int] = []
    assert made() == [None, None], "only a name"
    assert made("--mask", mask) == [MASK, None]
    assert made("--intrinsics", "-", stdin=lens.read_text()) == [MASK, LENS]
    assert made() == [MASK, LENS]
    assert made("--mask", nothing) == [None, LENS]
    assert made("--mask", "-", "--intrinsics", nothing, stdin=mask.read_text()) == [MASK, None]
    values += [0, 1023]
    assert made("--intrinsics", lens, "--depth-bits", 10) == [MASK, LENS]
    values[:] = [7000, 9000]
    assert made("--value-range", 7000, 9000) == made() == [MASK, LENS]

    placerec("maps", "cameras", "put", lab, "rear", *where)
    listed = json.loads(placerec("maps", "cameras", "list", lab, "--json", *where).stdout)
    assert [camera["name"] for camera in listed] == ["front", "rear"]
    front, rear = cells(placerec("maps", "cameras", "list", lab, *where).stdout)[1:]
    assert " ".join(front).startswith("front 1 polygon 640 x 480, distortion plumb_bob 7000 to 9000 2")
    assert rear[:3] == ["rear", "–", "–"]
    shown = cells(placerec("maps", "cameras", "show", lab, "front", *where).stdout)
    assert ["polygon", "1", "(0,", "0.75)", "(1,", "0.75)", "(1,", "1)", "(0,", "1)"] in shown
    assert ["fx", "554.3125"] in shown and ["distortion_model", "plumb_bob"] in shown

    delete = ("maps", "cameras", "delete", lab, "front", *where)
    assert f"Delete the camera front of the map {lab}?" in placerec(*delete, status=1, stdin="n\n").output
    assert f"The camera front of the map {lab} is deleted." in placerec(*delete, stdin="y\n").stderr
    assert "has no camera 'front'" in placerec(*delete, "--yes", status=1).stderr
    assert "has no camera 'front'" in placerec("maps", "cameras", "show", lab, "front", *where, status=1).stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "Standard input is not valid JSON: "),
        ('{"polygons": [[[0, NaN], [1, 0], [1, 1]]]}', "Standard input is not valid JSON: NaN is no number."),
        ("[" * 100_000, "Standard input is not valid JSON: "),
        ('{"polygons": [[[0, 0], [1, 2], [1, 1]]]}', "mask"),
        ('{"mask": null}', "mask"),
    ],
)
def test_a_wrong_mask_is_refused_and_nothing_is_made(
    placerec: Placerec, server: Server, map_id: str, text: str, message: str
) -> None:
    words = ("maps", "cameras", "put", map_id, "front", "--mask", "-", "--url", server.client.base_url)
    assert message in placerec(*words, status=1, stdin=text).stderr
    assert server.client.get(f"/v1/maps/{map_id}/cameras").json()["items"] == []


def test_wrong_words_are_refused(placerec: Placerec, server: Server, tmp_path: Path) -> None:
    put, there = ("maps", "cameras", "put", "nosuch", "front"), ("--url", server.client.base_url)
    placerec(*put, "--mask", "-", "--intrinsics", "-", *there, status=2)
    placerec(*put, "--depth-bits", 10, "--value-range", 0, 9, *there, status=2)
    placerec(*put, "--depth-bits", 17, *there, status=2)
    missing = placerec(*put, "--mask", tmp_path / "missing.json", *there, status=1).stderr
    assert "missing.json cannot be read: No such file or directory." in missing
    assert "nosuch" in placerec(*put, *there, status=1).stderr
