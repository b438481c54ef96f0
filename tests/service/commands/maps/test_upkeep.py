"""``placerec maps health|re-encode|prune|merge`` and ``placerec jobs``: on the data directory and over HTTP."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from pathlib import Path

import pytest

from tests.service.commands.conftest import Placerec
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import encoded, scene, seen_again
from tests.service.server import Server


@pytest.fixture(params=["here", "over HTTP"])
def where(request: pytest.FixtureRequest, tmp_path: Path) -> list[str]:
    """The words that choose the mode; both have the coarse encoder."""
    if request.param == "here":
        install_coarse_encoder(tmp_path / "models")
        return []
    running: Server = request.getfixturevalue("server")
    return ["--url", str(running.client.base_url)]


@pytest.fixture
def tuesday(tmp_path: Path) -> Path:
    """Another traverse, of two other scenes."""
    folder = tmp_path / "tuesday"
    folder.mkdir()
    for index in (5, 6):
        (folder / f"{index}.jpg").write_bytes(encoded(scene(index)))
    return folder


@pytest.mark.thorough
def test_looking_after_maps(placerec: Placerec, where: list[str], monday: Path, tuesday: Path) -> None:
    lab, hall, anew = (f"{name}-{len(where)}" for name in ("looked-after", "taken-in", "made-anew"))
    for name, folder in ((lab, monday), (hall, tuesday)):
        placerec("maps", "create", name, "--encoder", COARSE, "--keep", "image", *where)
        placerec("enrol", folder, "--map", name, *where)

    told = placerec("maps", "merge", lab, hall, "--json", *where)
    assert json.loads(told.stdout)["result"]["coming"] == 2
    merged = placerec("maps", "merge", lab, hall, "--yes", "--json", *where)
    assert json.loads(merged.stdout)["result"]["places"] == 6
    placerec("maps", "merge", lab, lab, *where, status=1)

    made = placerec("maps", "re-encode", lab, anew, "--encoder", "m-region-vlad", *where)
    assert "succeeded" in made.stdout
    assert json.loads(placerec("maps", "show", anew, "--json", *where).stdout)["places"] == 6
    taken = placerec("maps", "re-encode", lab, anew, *where, status=1)
    assert anew in taken.stderr

    report = placerec("maps", "health", lab, *where).stdout
    assert "places" in report and "6" in report
    assert json.loads(placerec("maps", "health", lab, "--json", *where).stdout)["places"] == 6

    pruned = placerec("maps", "prune", lab, "--similarity", 2, "--yes", "--json", *where)
    assert json.loads(pruned.stdout)["result"]["removed"] == 0, "nothing is so alike"
    dry = placerec("maps", "prune", lab, *where)
    assert "Nothing is deleted without --yes" in " ".join(dry.stderr.split())
    printed = dry.stdout
    assert re.search(r"recall_before +[01]\.\d{3} \(0\.\d{3} to [01]\.\d{3}; \d of \d\)", printed)
    assert re.search(r"^similarity +removed +recall *$", printed, re.MULTILINE), "what was tried is a table"
    assert not re.search(r"[{}\['\]]|None|True|False", printed), printed
    assert "sequence" in placerec("maps", "prune", lab, "--sequence", "none", *where, status=1).stderr

    listed = json.loads(placerec("jobs", "list", "--map", lab, "--json", *where).stdout)
    assert [job["kind"] for job in listed] == ["prune", "prune", "re-encode", "merge", "merge"]
    assert "re-encode" in placerec("jobs", "list", "--map", lab, "--state", "succeeded", *where).stdout
    shown = placerec("jobs", "show", listed[0]["id"], "--json", *where)
    assert json.loads(shown.stdout) == listed[0]
    assert "succeeded" in placerec("jobs", "wait", listed[0]["id"], *where).stdout
    assert "already" in placerec("jobs", "cancel", listed[0]["id"], *where, status=1).stderr
    placerec("jobs", "show", "none", *where, status=1)


@pytest.mark.thorough
def test_aligning_traverses(placerec: Placerec, where: list[str], tmp_path: Path) -> None:
    name = f"aligned-{len(where)}"
    placerec("maps", "create", name, "--encoder", COARSE, *where)
    for day in range(2):
        folder = tmp_path / f"day{day}"
        folder.mkdir()
        for index in range(12):
            frame = scene(index) if not day else seen_again(scene(index), index)
            (folder / f"{day}-{index}.jpg").write_bytes(encoded(frame))
    first = placerec("enrol", tmp_path / "day0", "--map", name, "--align", *where).stdout
    assert "0 of 12 frames show places of other traverses" in first
    second = placerec("enrol", tmp_path / "day1", "--map", name, "--align", *where).stdout
    assert "frames show places of other traverses (day0: 1" in second
    assert "Calibration: impossible: A calibration rests on at least" in " ".join(second.split())
    asked = ("maps", "align", name, "--sequence", "day1", "--json", *where)
    told = json.loads(placerec(*asked, "--with", "day0", "--no-poses", "--dry-run").stdout)
    assert told["arguments"] == {"sequence": "day1", "with": ["day0"], "poses": False, "dry_run": True}
    assert not told["result"]["stored"] and told["result"]["paired"] >= 10
    undone = json.loads(placerec(*asked, "--undo").stdout)
    assert undone["result"]["stations_changed"] >= 10
    assert "day2" in placerec("maps", "align", name, "--sequence", "day2", *where, status=1).stderr
    placerec(*asked, "--undo", "--with", "day0", status=2)


@pytest.mark.thorough
def test_a_job_that_fails_ends_in_a_sentence(placerec: Placerec, where: list[str]) -> None:
    name = f"empty-{len(where)}"
    placerec("maps", "create", name, "--encoder", COARSE, *where)
    assert "Traceback" not in placerec("maps", "prune", name, *where, status=1).stderr


def test_without_a_service_jobs_are_waited_for(placerec: Placerec) -> None:
    assert "--url" in placerec("maps", "prune", "lab", "--no-wait", status=1).stderr


@pytest.mark.thorough
def test_rebuilding_all_maps(placerec: Placerec, tmp_path: Path) -> None:
    """One map that cannot be read keeps no other one from being rebuilt."""
    install_coarse_encoder(tmp_path / "models")
    for name in ("attic", "lab", "yard"):
        placerec("maps", "create", name, "--encoder", COARSE)
    rebuilt = json.loads(placerec("maps", "rebuild", "--all", "--json").stdout)
    every = {name: (job["kind"], job["state"]) for name, job in rebuilt.items()}
    assert every == dict.fromkeys(("attic", "lab", "yard"), ("rebuild", "succeeded"))
    assert all(job["ended_at"] <= later["started_at"] for job, later in pairwise(rebuilt.values()))

    (tmp_path / "data/maps/lab/map.sqlite").write_bytes(b"damaged")
    failed = placerec("maps", "rebuild", "--all", status=1)
    assert re.findall(r"^(\w+) +(succeeded|refused|failed)", failed.stdout, re.MULTILINE) == [
        ("attic", "succeeded"), ("lab", "refused"), ("yard", "succeeded"),
    ]  # fmt: skip
    assert "Not rebuilt: lab." in failed.stderr
    placerec("maps", "rebuild", status=2)
    placerec("maps", "rebuild", "lab", "--all", status=2)
    placerec("maps", "rebuild", "--all", "--no-wait", status=2)
