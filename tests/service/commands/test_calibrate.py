"""``placerec calibrate``: by a traverse, by labelled frames, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.service.commands.conftest import Placerec
from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server

PLACES = 12


@pytest.fixture(scope="module")
def strip(server: Server) -> str:
    """Twelve places of one traverse, and the same seen again in another."""
    server.create_map("strip")
    for number in range(PLACES):
        pose = {"x": 20 * number, "y": 0}
        server.enrol("strip", f"m{number}", jpeg(number), **pose, sequence="monday")
        server.enrol("strip", f"t{number}", encoded(seen_again(scene(number), number)), **pose, sequence="tuesday")
    return "strip"


@pytest.fixture
def there(server: Server) -> list[str]:
    return ["--url", str(server.client.base_url)]


@pytest.mark.thorough
def test_by_a_traverse_with_its_figures(placerec: Placerec, server: Server, strip: str, there: list[str]) -> None:
    words = ("calibrate", strip, "--sequence", "tuesday", "--precision", 0.8)
    dry = placerec(*words, "--dry-run", *there)
    assert "would be calibrated by 12 frames" in dry.stdout
    assert "area under the ROC" in dry.stdout
    assert "12 frames" in dry.stderr
    for title in ("Verdicts on frames held out", "Thresholds alone, on all frames"):
        assert title in dry.stdout
    assert "its recall is another" in " ".join(dry.stderr.split()), "which recall is which"
    told = json.loads(placerec(*words, "--json", *there).stdout)
    assert told["stored"] is True
    assert server.client.get(f"/v1/maps/{strip}").json()["calibration"] == told["calibration"]


def test_pairs_of_a_file(placerec: Placerec, tmp_path: Path, strip: str, there: list[str]) -> None:
    pairs = tmp_path / "pairs.csv"
    pairs.write_text("place,shows\n" + "".join(f"t{n},m{n}\n" for n in range(11)) + "t11,\n")
    words = (
        "calibrate",
        strip,
        "--sequence",
        "tuesday",
        "--pairs",
        pairs,
        "--mean-of-negatives",
        "--dry-run",
        "--json",
    )
    assert json.loads(placerec(*words, *there).stdout)["measurement"]["known"] == 11


@pytest.mark.thorough
def test_labelled_frames_of_a_folder(placerec: Placerec, tmp_path: Path, strip: str, there: list[str]) -> None:
    rows = ["file,place"]
    for number in range(PLACES):
        (tmp_path / f"{number}.jpg").write_bytes(encoded(seen_again(scene(number), 50 + number)))
        rows.append(f"{number}.jpg,m{number}")
    (tmp_path / "stranger.jpg").write_bytes(jpeg(99))
    rows.append("stranger.jpg,")
    (tmp_path / "labels.csv").write_text("\n".join(rows) + "\n")
    words = ("calibrate", strip, "--frames", tmp_path / "labels.csv", "--false-accept-rate", 0.2, "--dry-run", "--json")
    measured = json.loads(placerec(*words, *there).stdout)["measurement"]
    assert (measured["known"], measured["unknown"]) == (PLACES, PLACES + 1)


def test_what_it_refuses(placerec: Placerec, tmp_path: Path, strip: str, there: list[str]) -> None:
    assert "give exactly one of" in placerec("calibrate", strip, *there, status=2).stderr
    both = ("--sequence", "tuesday", "--precision", 0.9, "--mean-of-negatives")
    assert "give at most one of" in placerec("calibrate", strip, *both, *there, status=2).stderr
    assert "needs --sequence" in placerec("calibrate", strip, "--itself", "--pairs", tmp_path, *there, status=2).stderr
    percent = placerec("calibrate", strip, "--sequence", "tuesday", "--precision", 95, *there, status=2).stderr
    assert "a share between 0 and 1" in " ".join(percent.replace("│", " ").split())
    empty = tmp_path / "empty.csv"
    empty.write_text("file,place\n")
    assert "no row" in placerec("calibrate", strip, "--frames", empty, *there, status=1).stderr
    empty.write_text("file\n1.jpg\n")
    assert "columns file,place" in placerec("calibrate", strip, "--frames", empty, *there, status=1).stderr
    refused = placerec("calibrate", strip, "--sequence", "tuesday", "--precision", 0.999, *there, status=1)
    assert "promise" in refused.stderr
