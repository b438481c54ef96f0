"""``placerec bench``: it runs and its figures agree with one another; how high they are is not tested here."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.service.commands.conftest import Placerec
from tests.service.scenes import encoded, scene


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


def test_a_frame_of_ones_own(placerec: Placerec, tmp_path: Path) -> None:
    (tmp_path / "frame.png").write_bytes(encoded(scene(0), ".png"))
    placerec("bench", "--image", tmp_path / "frame.png", "--rounds", 3, "--places", 2)
    (tmp_path / "frame.png").write_bytes(b"nothing")
    refused = placerec("bench", "--image", tmp_path / "frame.png", "--rounds", 3, status=1)
    assert refused.stderr.count("Error: ") == 1
