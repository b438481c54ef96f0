"""``placerec evaluate``: which systems there are, and which are made."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer

from core.method.catalogue import EncoderCatalogue
from lab.baselines.registry import systems
from lab.commands.evaluation.systems import build_systems, parse_weights
from lab.evaluation.data.presets import DATASETS
from tests.service.commands.conftest import Placerec
from tests.service.scenes import jpeg


def test_the_list_shows_every_system_and_data_set(placerec: Placerec) -> None:
    shown = placerec("evaluate", "--list").stdout
    for about in systems(EncoderCatalogue()):
        assert about.name in shown and about.paper in shown
        assert about.weights is None or f"--weights {about.name}=FILE: {about.weights}" in shown
    assert all(dataset.name in shown for dataset in DATASETS)
    assert "N 200, regions conv4" in shown
    assert "━" not in shown
    (line,) = [line for line in shown.splitlines() if line.startswith("seqslam ")]
    assert "ICRA 2012" in line and "R_x 64" in line and line.rstrip().endswith("none")


def test_weights_are_parsed() -> None:
    assert parse_weights(["netvlad=a.mat", "calc=b=c.caffemodel"]) == {
        "netvlad": Path("a.mat"),
        "calc": Path("b=c.caffemodel"),
    }
    for wrong in (["netvlad"], ["=file"], ["netvlad="], ["a=b", "a=c"]):
        with pytest.raises(typer.BadParameter):
            parse_weights(wrong)


def test_systems_come_once_in_the_order_requested() -> None:
    built = build_systems(["seqslam", "hog", "seqslam"], False, {}, EncoderCatalogue())
    assert [system.about.name for system in built] == ["seqslam", "hog"]


@pytest.mark.thorough
def test_all_are_those_that_need_no_file() -> None:
    models = EncoderCatalogue()
    damaged = {summary.name for summary in models.describe() if summary.damaged}
    free = [about.name for about in systems(models) if about.weights is None and about.name not in damaged]
    assert len(free) >= 14
    assert [system.about.name for system in build_systems([], True, {}, models)] == free
    assert build_systems(["hog"], True, {}, models)[0].about.name == "hog"


def test_missing_weights_are_reported_in_a_sentence_before_anything_runs(placerec: Placerec, tmp_path: Path) -> None:
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "0.jpg").write_bytes(jpeg(0))
    both = ("--reference", tmp_path / "r", "--query", tmp_path / "r", "--tolerance", 0, "--encoder", "hog")
    said = placerec("evaluate", *both, "--encoder", "netvlad", status=1)
    assert "netvlad needs --weights netvlad=FILE" in said.stderr and said.stdout == ""
    said = placerec("evaluate", *both, "--encoder", "netvlad", "--weights", "netvlad=no.mat", status=1)
    assert "there is no file no.mat" in said.stderr
    idle = placerec("evaluate", *both, "--weights", "netvlad=no.mat", status=2)
    assert "--encoder does not name" in idle.stderr.replace("\n", " ").replace("│", "").replace("  ", " ")
