"""``placerec bench``: it runs and its figures agree with one another; how high they are is not tested here."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.service.commands.conftest import Placerec
from tests.service.scenes import encoded, scene
from tests.service.server import Server


@pytest.mark.thorough
def test_the_figures(placerec: Placerec, tmp_path: Path) -> None:
    file = tmp_path / "out" / "bench.json"
    shown = placerec("bench", "--rounds", 3, "--places", 20, "--encoder", "region-vlad", "--json", file).stdout
    assert "bare forward pass" in shown
    assert "search of 20" in shown
    figures = json.loads(file.read_text())
    times = figures["milliseconds"]
    assert figures["encoder"].startswith("region-vlad@")
    assert times["forward"] == min(times["contiguous"], times["channels last"])
    assert figures["ratio"]["encode"] == pytest.approx(times["encode"] / times["forward"])
    assert all(value > 0 for value in times.values())
    assert "16 together" in shown and figures["batched_frames_per_second"] == pytest.approx(1e3 / times["batch"])


@pytest.mark.thorough
def test_a_frame_of_ones_own(placerec: Placerec, tmp_path: Path) -> None:
    (tmp_path / "frame.png").write_bytes(encoded(scene(0), ".png"))
    placerec("bench", "--image", tmp_path / "frame.png", "--rounds", 3, "--places", 2, "--encoder", "region-vlad")
    (tmp_path / "frame.png").write_bytes(b"nothing")
    refused = placerec("bench", "--image", tmp_path / "frame.png", "--rounds", 3, status=1)
    assert refused.stderr.count("Error: ") == 1


@pytest.mark.thorough
def test_a_running_service(placerec: Placerec, tmp_path: Path, server: Server, traverse: str) -> None:
    file, url = tmp_path / "bench.json", str(server.client.base_url)
    words = ("--robots", 1, "--robots", 4, "--seconds", 0.5, "--json", file)
    shown = placerec("bench", "--url", url, "--map", traverse, *words).stdout
    assert "p99 ms" in shown
    figures = json.loads(file.read_text())
    assert figures["path"] == f"/v1/maps/{traverse}/query"
    for robots in ("1", "4"):
        seen = figures["robots"][robots]
        assert seen["answers"] > 0 and seen["refused"] == 0
        assert seen["statuses"] == {"200": seen["answers"]}
        assert seen["p50"] <= seen["p95"] <= seen["p99"]
    placerec("bench", "--url", url, "--robots", 2, "--seconds", 0.3)


def test_what_cannot_be_measured_is_refused(placerec: Placerec, tmp_path: Path, server: Server) -> None:
    url = str(server.client.base_url)
    assert "no map" in placerec("bench", "--url", url, "--map", "absent", status=1).stderr
    (tmp_path / "frame.jpg").write_bytes(b"nothing")
    placerec("bench", "--url", url, "--image", tmp_path / "frame.jpg", status=1)
    placerec("bench", "--url", "http://127.0.0.1:1", status=1)
