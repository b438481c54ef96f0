"""``placerec maps``: the same commands on the data directory and over HTTP."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from core.disk.reserve import FILE as RESERVE
from tests.service.commands.conftest import Placerec


@pytest.mark.thorough
def test_a_map_from_its_making_to_its_end(placerec: Placerec, where: list[str]) -> None:
    name = f"hall-{len(where)}"
    made = placerec("maps", "create", name, "--description", "by day", "--same-place-radius", 2.5, "--json", *where)
    assert json.loads(made.stdout)["same_place_radius"] == 2.5
    assert json.loads(made.stdout)["encoder"].startswith("m-region-vlad@")
    again = placerec("maps", "create", name, *where, status=1)
    assert name in again.stderr

    edited = placerec("maps", "edit", name, "--threshold", 0.25, "--keep", "image", "--json", *where)
    assert json.loads(edited.stdout)["calibration"]["threshold"] == 0.25
    assert json.loads(edited.stdout)["description"] == "by day"
    table = placerec("maps", "show", name, *where).stdout
    assert "threshold 0.250" in table
    assert "by day" in table
    taught = placerec("maps", "edit", name, "--learning", "propose", *where).stdout
    assert "mode: propose; least_probability: 0.95" in taught and "'" not in taught
    unreachable = placerec("maps", "edit", name, "--threshold", 5, *where, status=1)
    assert "from -1 to 1" in " ".join(unreachable.stderr.split())
    default = placerec("maps", "edit", name, "--default-calibration", "--json", *where)
    assert json.loads(default.stdout)["calibration"]["source"] == "encoder-default"

    listed = json.loads(placerec("maps", "list", "--json", *where).stdout)
    assert name in [item["id"] for item in listed["items"]]
    assert listed["quarantined"] == []
    assert name in placerec("maps", "list", *where).stdout
    assert "is not damaged: 0 places" in placerec("maps", "verify", name, *where).stdout

    placerec("maps", "delete", name, *where, status=1, stdin="n\n")
    placerec("maps", "delete", name, *where, stdin="y\n")
    assert name in placerec("maps", "show", name, *where, status=1).stderr


def test_an_edit_must_change_something(placerec: Placerec) -> None:
    placerec("maps", "edit", "lab", status=2)
    placerec("maps", "edit", "lab", "--default-calibration", "--margin", 0.1, status=2)


@pytest.mark.thorough
def test_places_and_sequences(placerec: Placerec, monday: Path, where: list[str], tmp_path: Path) -> None:
    name = f"places-{len(where)}"
    placerec("enrol", monday, "--map", name, "--create", *where)

    placerec("maps", "places", "edit", name, "9", "--x", 1, "--y", 2, "--metadata", '{"door": "open"}', *where)
    edit = ("maps", "places", "edit", name, "9", "--json", *where)
    moved = json.loads(placerec(*edit, "--heading", 90).stdout)
    assert moved["pose"] == {"x": 1.0, "y": 2.0, "heading": 90.0}
    assert moved["metadata"] == {"door": "open"}
    # A pose in the other frame of reference takes the place of the old one only when told so.
    assert "latitude" in placerec(*edit, "--latitude", 48, "--longitude", 2, status=1).stderr
    on_earth = json.loads(placerec(*edit, "--clear", "pose", "--latitude", 48, "--longitude", 2).stdout)
    assert on_earth["pose"] == {"latitude": 48.0, "longitude": 2.0}
    cleared = json.loads(placerec(*edit, "--clear", "pose", "--clear", "metadata").stdout)
    assert cleared["pose"] is None
    assert cleared["metadata"] == {}
    placerec(*edit, status=2)
    placerec(*edit, "--clear", "id", status=2)
    assert "--metadata is not valid JSON" in placerec(*edit, "--metadata", "{", status=1).stderr

    picture = tmp_path / "thumbnail.jpg"
    placerec("maps", "places", "thumbnail", name, "9", picture, *where)
    assert picture.read_bytes().startswith(b"\xff\xd8")
    shown = placerec("maps", "places", "show", name, "9", *where).stdout
    assert "monday" in shown
    assert ["camera", "–"] in [line.split() for line in shown.splitlines()]

    delete = ("maps", "places", "delete", name, "1", "2")
    told = placerec(*delete, "11", "1\u200b", "--yes", *where, status=1).stderr
    assert f"The map {name} has no place 11, 1\\u200b; nothing was deleted." in told, "the space is seen"
    asked = placerec(*delete, *where, status=1, stdin="n\n")
    assert f"Delete from the map {name}: 1, 2?" in asked.output
    assert len(json.loads(placerec("maps", "places", "list", name, "--json", *where).stdout)) == 4
    assert "Deleted: 1, 2." in placerec(*delete, "1", *where, stdin="y\n").stderr
    listed = json.loads(placerec("maps", "places", "list", name, "--sequence", "monday", "--json", *where).stdout)
    assert [place["id"] for place in listed] == ["9", "10"]
    missing = placerec("maps", "sequences", "delete", name, "nosuch", "--erase", "--yes", *where, status=1)
    assert f"The map {name} has no sequence nosuch; nothing was deleted." in missing.stderr
    assert "nosuch" in placerec("maps", "sequences", "delete", name, "nosuch", "--yes", *where, status=1).stderr
    forgotten = placerec("maps", "sequences", "delete", name, "monday", "--yes", *where)
    assert "2 places" in forgotten.stderr
    assert json.loads(placerec("maps", "sequences", "list", name, "--json", *where).stdout) == []


@pytest.mark.thorough
def test_damage_is_found(placerec: Placerec, monday: Path, tmp_path: Path) -> None:
    placerec("enrol", monday, "--map", "lab", "--create")
    files = [path for path in (tmp_path / "data").rglob("*") if path.is_file() and path.name != RESERVE]
    largest = max(files, key=lambda path: path.stat().st_size)
    content = bytearray(largest.read_bytes())
    content[len(content) // 2] ^= 0xFF
    largest.write_bytes(content)
    verified = placerec("maps", "verify", "lab", status=1)
    assert "damaged" in verified.stderr


@pytest.mark.thorough
def test_a_text_from_anybody_is_shown_as_it_is(placerec: Placerec, monday: Path, where: list[str]) -> None:
    """Markup of the terminal library is text; characters that drive a terminal, or turn a line around, are named."""
    name, text = f"shown-{len(where)}", "[/oops] [red]west[/red] \x1b[31m\x9b2J\u202egnissorc"
    placerec("maps", "create", name, "--description", text, *where)
    shown = "[/oops] [red]west[/red] \\u001b[31m\\u009b2J\\u202egnissorc"
    for words in (("maps", "list"), ("maps", "show", name)):
        assert shown in placerec(*words, *where).stdout
    as_json = placerec("maps", "show", name, "--json", *where).stdout
    assert "\\u202e" in as_json and not {"\x1b", "\x9b", "\u202e"} & set(as_json)
    assert json.loads(as_json)["description"] == text
    refused = placerec("maps", "show", "[/oops]\u202e", *where, status=1)
    assert not {"\x1b", "\u202e"} & set(refused.stderr)
