"""``placerec evaluate``: which traverses are taken, and what is said to be true of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from lab.commands.evaluation.traverses import name_pair
from lab.evaluation.data.datasets import find_dataset, open_dataset
from tests.lab.evaluation.data.test_layouts import TREES
from tests.service.commands.conftest import Placerec
from tests.service.scenes import encoded, jpeg, scene, seen_again

EVAL = Path(__file__).parents[5] / "shared/datasets/eval"


@pytest.fixture
def gardens(tmp_path: Path) -> Path:
    """Gardens Point with eight places."""
    folder = tmp_path / "gardens"
    for name in ("night_right", "day_left"):
        (folder / name).mkdir(parents=True)
    for place in range(8):
        (folder / "night_right" / f"{place}.jpg").write_bytes(jpeg(place))
        (folder / "day_left" / f"{place}.jpg").write_bytes(encoded(seen_again(scene(place))))
    return folder


def figures(placerec: Placerec, folder: Path, *words: object) -> Any:
    placerec("evaluate", *words, "--encoder", "hog", "--json", folder / "out.json")
    return json.loads((folder / "out.json").read_text())


def test_a_data_set_brings_its_traverses_and_its_truth(placerec: Placerec, gardens: Path, tmp_path: Path) -> None:
    found = figures(placerec, tmp_path, "--dataset", "gardens-point", "--data", gardens)
    assert (found["queries"], found["references"], found["recall_at"]["1"]) == (8, 8, 1.0)
    assert "The thesis counts 200 queries" in found["remarks"][0]


def test_a_limit_goes_with_a_data_set(placerec: Placerec, gardens: Path, tmp_path: Path) -> None:
    (tmp_path / "retained.txt").write_text("0\n1\n")
    words = ("--dataset", "gardens-point", "--data", gardens, "--limit-references", tmp_path / "retained.txt")
    found = figures(placerec, tmp_path, *words)
    assert (found["references"], found["negatives"]) == (2, 3)  # queries 5, 6 and 7 lost all of ±3
    assert found["auc_roc"] is not None
    assert found["thresholds"][0]["rule"] == "mean_of_negatives"


def test_poses_and_a_distance(placerec: Placerec, gardens: Path, tmp_path: Path) -> None:
    for name in ("night_right", "day_left"):
        rows = "".join(f"{place}.jpg,{place * 10},0,{place * 30}\n" for place in range(8))
        (gardens / name / "places.csv").write_text("file,x,y,heading\n" + rows)
    both = ("--reference", gardens / "night_right", "--query", gardens / "day_left", "--poses")
    wide = figures(placerec, tmp_path, *both, "--metres", 15)
    narrow = figures(placerec, tmp_path, *both, "--metres", 15, "--degrees", 20)
    assert wide["recall_at"]["1"] == narrow["recall_at"]["1"] == 1.0
    (tmp_path / "retained.txt").write_text("".join(f"{place}\n" for place in range(0, 8, 2)))
    limit = ("--limit-references", tmp_path / "retained.txt")
    assert figures(placerec, tmp_path, *both, "--metres", 15, *limit)["negatives"] == 0
    assert figures(placerec, tmp_path, *both, "--metres", 15, "--degrees", 20, *limit)["negatives"] == 4


def test_a_pair_has_the_name_of_its_folder(placerec: Placerec, gardens: Path) -> None:
    assert name_pair(gardens / "night_right", gardens / "day_left") == "gardens, day_left against night_right"
    assert name_pair(Path("/a/night"), Path("/b/day")) == "day against night"
    assert name_pair(Path("/night"), Path("/day")) == "day against night"
    both = ("--reference", gardens / "night_right", "--query", gardens / "day_left", "--tolerance", 0)
    assert "gardens, day_left against night_right: 8 queries" in placerec("evaluate", *both, "--encoder", "hog").stdout


def test_missing_data_names_the_folder(placerec: Placerec, tmp_path: Path) -> None:
    said = placerec("evaluate", "--dataset", "berlin-a100", "--data", tmp_path, status=1).stderr
    assert str(tmp_path / "berlin_A100_2") in said.replace("\n", "")
    said = placerec("evaluate", "--dataset", "kitti", "--data", tmp_path, status=1).stderr
    assert "no data set 'kitti'; there are gardens-point" in said


def test_what_does_not_go_together_is_refused(placerec: Placerec, gardens: Path, tmp_path: Path) -> None:
    both = ("--reference", gardens / "night_right", "--query", gardens / "day_left")
    known = ("--dataset", "gardens-point", "--data", gardens)
    (tmp_path / "retained.txt").write_text("0\n")
    for words in (
        (),
        ("--reference", gardens),
        ("--query", gardens, "--tolerance", 1),
        (*both, "--tolerance", 1, "--poses", "--metres", 5),
        (*both, "--poses"),
        (*both, "--tolerance", 1, "--metres", 5),
        (*both, "--tolerance", 1, "--degrees", 5),
        (*both, "--tolerance", 1, "--reduced"),
        (*both, "--tolerance", 1, "--data", gardens),
        ("--dataset", "gardens-point"),
        (*known, "--tolerance", 1),
        (*known, "--reference", gardens),
        (*known, "--reduced", "--limit-references", tmp_path / "retained.txt"),
    ):
        placerec("evaluate", *words, status=2)
    assert "here are 8 and 8" in placerec("evaluate", *known, "--reduced", status=1).stderr.replace("\n", " ")


@pytest.mark.thorough
@pytest.mark.skipif(not EVAL.is_dir(), reason="the traverses of ../shared/datasets are not here")
def test_hog_on_the_corridor_comes_near_what_was_published(placerec: Placerec, tmp_path: Path) -> None:
    """0.697 by VPR-Bench's stored similarities, on the same images and truth."""
    found = figures(placerec, tmp_path, "--dataset", "corridor", "--data", EVAL / "corridor")
    assert found["auc_pr"] == pytest.approx(0.697, abs=0.05)
    assert (found["queries"], found["references"]) == (111, 111)


OTHERS = {"AMOSNet": (0.954, 0.847), "NetVLAD": (0.822, 0.676), "RegionVLAD": (0.686, 0.432), "CoHOG": (0.687, 0.622)}
"""AUC-PR and recall@1 of VPR-Bench's stored matrices, as the data sets' README has them."""


@pytest.mark.thorough
@pytest.mark.skipif(not EVAL.is_dir(), reason="the traverses of ../shared/datasets are not here")
def test_what_others_have_computed_stands_beside_what_was_measured(placerec: Placerec, tmp_path: Path) -> None:
    corridor = EVAL / "corridor"
    words = ("--dataset", "corridor", "--data", corridor, "--others", corridor / "others")
    found = figures(placerec, tmp_path, *words)
    marked = {one["encoder"]: one for one in found["encoders"] if one.get("elsewhere")}
    assert len(marked) == 10 and len(found["encoders"]) == 11 and "elsewhere" not in found["encoders"][0]
    for name, (area, recall) in OTHERS.items():
        one = marked[f"{name} (computed elsewhere)"]
        assert (one["auc_pr"], one["recall_at"]["1"]) == pytest.approx((area, recall), abs=6e-4)


def test_others_belong_to_a_data_set(placerec: Placerec, gardens: Path, tmp_path: Path) -> None:
    both = ("--reference", gardens / "night_right", "--query", gardens / "day_left", "--tolerance", 0)
    assert "--others goes with --dataset" in placerec("evaluate", *both, "--others", tmp_path, status=2).stderr


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["berlin-kudamm", "17-places.vpr-bench", "gardens-point.vpr-tutorial"])
def test_a_published_tree_is_evaluated(placerec: Placerec, tmp_path: Path, name: str) -> None:
    dataset = find_dataset(name)
    builds = [build for (known, _), (_, build) in TREES.items() if known == name]
    builds[-1](tmp_path / "top")
    pair = open_dataset(dataset, tmp_path / "top")
    for place in range(len(pair.queries)):
        pair.references[place].write_bytes(jpeg(place))
        pair.queries[place].write_bytes(encoded(seen_again(scene(place))))
    found = figures(placerec, tmp_path, "--dataset", name, "--data", tmp_path / "top")
    assert (found["queries"], found["recall_at"]["1"]) == (12, 1.0)
    published = [one["system"] for one in found.get("published", [])]
    assert published == []  # none of these three has figures that could be read in a source
