"""``placerec query`` in both modes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.service.commands.conftest import Placerec
from tests.service.scenes import blank, encoded, scene, seen_again
from tests.service.server import Server


@pytest.mark.thorough
def test_a_second_look_is_recognized_where_the_threshold_lets_it(
    placerec: Placerec, monday: Path, tmp_path: Path
) -> None:
    placerec("enrol", monday, "--map", "lab", "--create")
    (tmp_path / "again.png").write_bytes(encoded(seen_again(scene(2)), ".png"))

    done = placerec("query", tmp_path / "again.png", monday / "10.jpg", "-m", "lab", "-k", 3, "--json")

    again, tenth = (json.loads(line) for line in done.stdout.splitlines())
    assert again["file"].endswith("again.png")
    assert (again["verdict"], again["place"]["id"]) == ("recognized", "9")
    assert [match["rank"] for match in again["matches"]] == [1, 2, 3]
    assert (tenth["verdict"], tenth["place"]["id"]) == ("recognized", "10")

    placerec("maps", "edit", "lab", "--threshold", 1)
    strict = json.loads(placerec("query", tmp_path / "again.png", "-m", "lab", "--json").stdout)
    assert (strict["verdict"], strict["place"]) == ("unknown", None)
    assert strict["matches"][0]["place"]["id"] == "9"
    placerec("maps", "edit", "lab", "--default-calibration")

    table = placerec("query", tmp_path / "again.png", "-m", "lab").stdout
    assert "recognized" in table
    assert "9" in table
    assert f"{again['score']:.3f}" in table


@pytest.mark.thorough
def test_over_http(placerec: Placerec, server: Server, traverse: str, tmp_path: Path) -> None:
    (tmp_path / "again.jpg").write_bytes(encoded(seen_again(scene(5))))
    done = placerec("query", tmp_path / "again.jpg", "-m", traverse, "--url", server.client.base_url, "--json")
    answer = json.loads(done.stdout)
    assert answer["matches"][0]["place"]["id"] == "p5"
    same = server.query(traverse, (tmp_path / "again.jpg").read_bytes())
    assert answer["score"] == same["score"]


def test_the_mask_of_a_camera_is_applied(placerec: Placerec, server: Server, map_id: str, tmp_path: Path) -> None:
    mask = {"polygons": [[[0, 0.5], [1, 0.5], [1, 1], [0, 1]]]}
    server.client.put(f"/v1/maps/{map_id}/cameras/front", json={"mask": mask}).raise_for_status()
    frames = tmp_path / "walk"
    frames.mkdir()
    (frames / "1.jpg").write_bytes(encoded(scene(1)))
    there = ("-m", map_id, "--url", server.client.base_url)
    placerec("enrol", frames, *there, "--camera", "back", status=1)
    assert server.client.get(f"/v1/maps/{map_id}").json()["places"] == 0
    placerec("enrol", frames, *there, "--camera", "front")
    assert server.client.get(f"/v1/maps/{map_id}/places/1").json()["camera"] == "front"
    assert "1 unchanged" in placerec("enrol", frames, *there, "--camera", "front").stdout
    masked, bare = (
        json.loads(placerec("query", frames / "1.jpg", *there, "--json", *words).stdout)
        for words in (("--camera", "front"), ())
    )
    assert masked["score"] > bare["score"] + 0.03
    placerec("query", frames / "1.jpg", *there, "--camera", "back", status=1)


def test_an_image_that_is_refused_does_not_stop_the_others(
    placerec: Placerec, server: Server, traverse: str, tmp_path: Path
) -> None:
    (tmp_path / "bad.jpg").write_bytes(b"nothing")
    (tmp_path / "small.png").write_bytes(encoded(blank(8, 8), ".png"))
    (tmp_path / "good.jpg").write_bytes(encoded(scene(1)))
    paths = [tmp_path / name for name in ("bad.jpg", "small.png", "good.jpg")]
    done = placerec("query", *paths, "-m", traverse, "--url", server.client.base_url, "--json", status=1)
    assert [json.loads(line)["matches"][0]["place"]["id"] for line in done.stdout.splitlines()] == ["p1"]
    assert "bad.jpg: " in done.stderr
    assert "small.png: " in done.stderr


def test_what_stops_it(placerec: Placerec, server: Server, tmp_path: Path) -> None:
    image = tmp_path / "good.jpg"
    image.write_bytes(encoded(scene(1)))
    url = server.client.base_url
    assert "no map" in placerec("query", image, "-m", "nowhere", "--url", url, status=1).stderr
    missing = placerec("query", tmp_path / "missing.jpg", "-m", "nowhere", "--url", url, status=1)
    assert "cannot be read" in missing.stderr
    assert placerec("query", image, "-m", "lab", "-k", 101, status=2).exit_code == 2


def test_what_is_known_of_the_place(placerec: Placerec, server: Server, traverse: str, tmp_path: Path) -> None:
    (tmp_path / "again.jpg").write_bytes(encoded(seen_again(scene(5))))
    asked = ("query", tmp_path / "again.jpg", "-m", traverse, "--url", server.client.base_url, "--json", "-k", 100)

    def ids(*options: object) -> set[str]:
        (line,) = placerec(*asked, *options).stdout.splitlines()
        return {match["place"]["id"] for match in json.loads(line)["matches"]}

    assert ids("--near", "10,0", "--radius", 2) == {"p4", "p5", "p6"}
    assert ids("--near", "10,0", "--radius", 2, "--soft", "position") == {f"p{number}" for number in range(8)}
    assert ids("--sequences", "tuesday") == ids("--where", '{"floor": 2}') == set()
    for degrees in (("--bbox", "0,0,1,1"), ("--near", "10,0", "--radius", 2, "--geographic")):
        assert "a map has one kind" in " ".join(placerec(*asked, *degrees, status=1).stderr.split())
    assert "two numbers" in placerec(*asked, "--near", "10", "--radius", 2, status=1).stderr
    assert "radius" in placerec(*asked, "--near", "10,0", status=1).stderr


def test_the_table_says_why_there_was_nothing_to_compare(
    placerec: Placerec, server: Server, traverse: str, tmp_path: Path
) -> None:
    (tmp_path / "again.jpg").write_bytes(encoded(scene(5)))
    asked = ("query", tmp_path / "again.jpg", "-m", traverse, "--url", server.client.base_url)
    assert "unknown (no-place-allowed)" in placerec(*asked, "--sequences", "mondy").stdout
    assert "(" not in placerec(*asked).stdout
