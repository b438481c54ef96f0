"""``placerec evaluate``: its contract, on traverses whose figures can be worked out by hand."""

from __future__ import annotations

import csv
import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.service.commands.conftest import Placerec
from tests.service.scenes import encoded, jpeg, scene, seen_again

CORRIDOR = Path(__file__).parents[5] / "shared/datasets/eval/corridor"


@pytest.fixture
def traverses(tmp_path: Path) -> tuple[Path, Path]:
    """References 0, 1, 2, 10 (scenes 0–3) and queries: 0 again, 2 unchanged, 2 again, 3 unchanged."""
    references, queries = tmp_path / "references", tmp_path / "queries"
    for folder in (references, queries):
        (folder / "deeper").mkdir(parents=True)
        (folder / "deeper" / "0.jpg").write_bytes(b"not looked at")
        (folder / "notes.txt").write_text("not an image")
    for name, seed in (("0", 0), ("1", 1), ("2", 2), ("10", 3)):
        (references / f"{name}.jpg").write_bytes(jpeg(seed))
    (queries / "a1.png").write_bytes(encoded(seen_again(scene(0)), ".png"))
    (queries / "a2.jpg").write_bytes(jpeg(2))
    (queries / "a3.jpg").write_bytes(encoded(seen_again(scene(2))))
    (queries / "a10.jpg").write_bytes(jpeg(3))
    return references, queries


def evaluated(placerec: Placerec, traverses: tuple[Path, Path], folder: Path, *words: object) -> tuple[Any, Any]:
    """The figures and the rows of the results."""
    json_file, results = folder / "out.json", folder / "out.csv"
    both = ("--reference", traverses[0], "--query", traverses[1], "--json", json_file, "--results", results)
    placerec("evaluate", *both, *words)
    with results.open() as file:
        assert file.readline() == "query,retrieved,score,matched\n"
        rows = list(csv.reader(file))
    return json.loads(json_file.read_text()), [(int(q), int(r), float(s), int(m)) for q, r, s, m in rows]


def test_the_figures_by_hand(placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path) -> None:
    # Query 1 shows reference 2 unchanged, but the truth says it shows 0 or 1: a confident mistake.
    truth = tmp_path / "truth.csv"
    truth.write_text("query,reference\n0,0\n1,0\n1,1\n2,2\n3,3\n")

    figures, rows = evaluated(placerec, traverses, tmp_path, "--ground-truth", truth)

    assert [(query, retrieved, matched) for query, retrieved, _, matched in rows] == [
        (0, 0, 1),
        (1, 2, 0),
        (2, 2, 1),
        (3, 3, 1),
    ]
    scores = [score for _, _, score, _ in rows]
    assert min(scores[1], scores[3]) > max(scores[0], scores[2])
    # Best first: the unchanged 1 (wrong) and 3 (right) in one order or the other, then two right ones.
    if scores[3] > scores[1]:
        curve = [(0, 1), (1 / 3, 1), (1 / 3, 1 / 2), (2 / 3, 2 / 3), (1, 3 / 4)]
    else:
        curve = [(0, 1), (0, 0), (1 / 3, 1 / 2), (2 / 3, 2 / 3), (1, 3 / 4)]
    area = sum((b[0] - a[0]) * (a[1] + b[1]) / 2 for a, b in pairwise(curve))
    assert figures["auc_pr"] == pytest.approx(area)
    assert figures["auc_roc"] is None
    assert figures["recall_at"] == {"1": 0.75, "5": 1.0, "10": 1.0}
    assert figures["recall_at_full_precision"] == (0.25 if scores[3] > scores[1] else 0.0)
    assert (figures["queries"], figures["references"]) == (4, 4)
    assert figures["encoder"].startswith("m-region-vlad@")
    assert set(figures["milliseconds"]) == {"forward", "regions", "vlad", "keypoints", "match"}
    assert all(value > 0 for value in figures["milliseconds"].values())
    assert [one["encoder"] for one in figures["encoders"]] == [figures["encoder"]]


def test_references_that_are_left_out_make_true_negatives(
    placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path
) -> None:
    retained = tmp_path / "retained.txt"
    retained.write_text("3\n0\n1\n")
    truth = tmp_path / "truth.csv"
    truth.write_text("0,0\n1,2\n2,2\n3,3\n")

    figures, rows = evaluated(
        placerec,
        traverses,
        tmp_path,
        "--ground-truth",
        truth,
        "--limit-references",
        retained,
        "--encoder",
        "region-vlad",
    )

    # Reference 2 is gone: queries 1 and 2 have no right answer, whatever they retrieve.
    assert [(query, matched) for query, _, _, matched in rows] == [(0, 1), (1, 0), (2, 0), (3, 1)]
    assert {retrieved for _, retrieved, _, _ in rows} <= {0, 1, 3}
    assert rows[3][1] == 3  # the index of the full directory
    scores = [score for _, _, score, _ in rows]
    assert min(scores[0], scores[3]) > max(scores[1], scores[2])
    assert (figures["auc_pr"], figures["auc_roc"], figures["recall_at"]["1"]) == (1.0, 1.0, 1.0)
    assert figures["recall_at_full_precision"] == 1.0
    assert (figures["queries"], figures["references"]) == (4, 3)


@pytest.mark.thorough
def test_several_encoders_and_a_tolerance(placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path) -> None:
    figures, rows = evaluated(
        placerec, traverses, tmp_path, "--tolerance", 1, "--encoder", "region-vlad", "--encoder", "m-region-vlad"
    )
    names = [one["encoder"].partition("@")[0] for one in figures["encoders"]]
    assert names == ["region-vlad", "m-region-vlad"]
    first = {key: value for key, value in figures.items() if key != "encoders"}
    assert first == figures["encoders"][0]
    # Query 1 retrieves reference 2: right within one.
    assert [matched for _, _, _, matched in rows] == [1, 1, 1, 1]
    assert figures["auc_pr"] == 1.0
    other = (tmp_path / "out.m-region-vlad.csv").read_text().splitlines()
    assert len(other) == 5


@pytest.mark.thorough
def test_the_default_is_judged_as_the_service_answers(
    placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path
) -> None:
    two = ("--tolerance", 0, "--encoder", "m-region-vlad", "--encoder", "m-region-vlad.two-stages")
    found = {}
    for verify in ("auto", "always", "never"):
        words = () if verify == "auto" else ("--verify", verify)
        figures, rows = evaluated(placerec, traverses, tmp_path, *two, *words)
        plain, beside = figures["encoders"]
        assert plain["encoder"].startswith("m-region-vlad@") and beside["encoder"].startswith("m-region-vlad.two-")
        assert plain["configuration"].get("verification.verify", "never") == verify
        assert (plain["verify"], beside["verify"]) == (verify, "never")
        assert plain["cached"] is False, "what another way of verifying gave is not taken"
        found[verify] = {retrieved: score for _, retrieved, score, _ in rows}
        with (tmp_path / "out.m-region-vlad.two-stages.csv").open() as file:
            stages = {int(row["retrieved"]): float(row["score"]) for row in csv.DictReader(file)}
        if verify != "auto":  # which leaves the scores if the best match alone settles an answer
            assert (found[verify] == stages) == (verify == "never")
    assert found["always"].keys() == found["never"].keys() and found["always"] != found["never"]
    told = placerec("evaluate", "--reference", traverses[0], "--query", traverses[1], *two).stdout
    assert re.search(r"^encoder +verified +AUC-PR", told, re.MULTILINE)
    assert re.search(r"^m-region-vlad +auto ", told, re.MULTILINE)
    assert re.search(r"^m-region-vlad.two-stages +never ", told, re.MULTILINE)
    placerec("evaluate", "--reference", traverses[0], "--query", traverses[1], *two, "--verify", "often", status=2)


def test_an_image_that_cannot_be_decoded_stops_the_run(
    placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path
) -> None:
    references, queries = traverses
    (queries / "a4.jpg").write_bytes(jpeg(0)[:400])
    words = ("--reference", references, "--query", queries, "--tolerance", 0, "--json", tmp_path / "out.json")
    stopped = placerec("evaluate", *words, status=1)
    assert "a4.jpg: " in stopped.stderr
    assert not (tmp_path / "out.json").exists()


def test_what_is_refused(placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path) -> None:
    references, queries = traverses
    both = ("--reference", references, "--query", queries)
    placerec("evaluate", *both, status=2)
    placerec("evaluate", *both, "--tolerance", 1, "--ground-truth", tmp_path / "truth.csv", status=2)
    placerec("evaluate", *both, "--tolerance", -1, status=2)
    assert "cannot be read" in placerec("evaluate", *both, "--ground-truth", tmp_path / "no.csv", status=1).stderr
    unknown = placerec("evaluate", *both, "--tolerance", 0, "--encoder", "nowhere", status=1)
    assert "no system 'nowhere' is known; there are " in unknown.stderr
    assert all(f" {name}," in unknown.stderr for name in ("m-region-vlad", "region-vlad", "hog"))
    placerec("evaluate", *both, "--tolerance", 0, "--cache", tmp_path, "--no-cache", status=2)
    placerec("evaluate", *both, "--tolerance", 0, "--transposed", status=2)
    empty = placerec("evaluate", "--reference", tmp_path, "--query", queries, "--tolerance", 0, status=1)
    assert "holds no image" in empty.stderr


def test_a_second_run_takes_what_was_measured(placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path) -> None:
    words = ("--tolerance", 0, "--encoder", "hog")
    first, rows = evaluated(placerec, traverses, tmp_path, *words)
    assert not first["cached"]
    retained = list((tmp_path / "cache/placerec/evaluations").iterdir())
    assert len(retained) == 1

    second, again = evaluated(placerec, traverses, tmp_path, *words, "--encoder", "seqslam")
    assert again == rows
    assert [one["cached"] for one in second["encoders"]] == [True, False]
    assert second["milliseconds"] == first["milliseconds"]  # the times of the first run
    both = ("--reference", traverses[0], "--query", traverses[1])
    said = placerec("evaluate", *both, *words, "--encoder", "seqslam").stderr
    assert "Taken from the cache, times included: " in said
    assert sorted(said.split("times included: ")[1].strip(".\n").split(", ")) == ["hog", "seqslam"]

    fresh, _ = evaluated(placerec, traverses, tmp_path, *words, "--no-cache")
    assert not fresh["cached"]
    elsewhere, _ = evaluated(placerec, traverses, tmp_path, *words, "--cache", tmp_path / "mine")
    assert not elsewhere["cached"] and len(list((tmp_path / "mine").iterdir())) == 1
    retained[0].write_bytes(b"damaged")
    mended, rows_again = evaluated(placerec, traverses, tmp_path, *words)
    assert not mended["cached"] and rows_again == rows


def test_a_cache_that_cannot_be_written_is_reported(
    placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    words = ("--reference", traverses[0], "--query", traverses[1], "--tolerance", 0, "--encoder", "hog")
    assert "Nothing was cached" in placerec("evaluate", *words, "--cache", tmp_path / "file").stderr


@pytest.mark.thorough
def test_systems_that_learn_say_from_what(placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path) -> None:
    words = ("--tolerance", 0, "--encoder", "fabmap")
    own, _ = evaluated(placerec, traverses, tmp_path, *words)
    assert own["trained_on"] == own["configuration"]["trained on"] == "the retained references"
    lessons = tmp_path / "lessons"
    for seed in range(6):
        folder = lessons / f"day{seed % 2}"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{seed}.jpg").write_bytes(jpeg(seed + 10))
    other, _ = evaluated(placerec, traverses, tmp_path, *words, "--training", lessons)
    assert other["trained_on"] == "6 images of lessons"
    assert other["encoder"] != own["encoder"]


@pytest.mark.thorough
def test_growing_traverses_and_disturbed_queries(
    placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path
) -> None:
    figures, _ = evaluated(
        placerec, traverses, tmp_path, "--tolerance", 1, "--encoder", "hog", "--scalability", "--severity"
    )
    assert [(point["system"], point["references"]) for point in figures["scalability"]] == [("hog", 4)]
    curves = {curve["disturbance"]: curve for curve in figures["severity"]}
    assert set(curves) == {"lateral shift", "scale", "darkness", "noise", "blur", "occlusion"}
    for curve in curves.values():
        assert len(curve["levels"]) == len(curve["auc_pr"]) == len(curve["recall_at_1"]) == 5
        assert curve["recall_at_1"][0] == figures["recall_at"]["1"]
        assert curve["auc_pr"][0] == pytest.approx(figures["auc_pr"])


@pytest.mark.thorough
def test_the_report_is_written(placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path) -> None:
    words = ("--reference", traverses[0], "--query", traverses[1], "--tolerance", 0, "--encoder", "hog")
    placerec("evaluate", *words, "--report", tmp_path / "report")
    page = (tmp_path / "report" / "index.html").read_text()
    assert "HOG" in page
    assert list((tmp_path / "report").rglob("*.png"))


def test_one_class_has_a_word_in_the_table(placerec: Placerec, traverses: tuple[Path, Path], tmp_path: Path) -> None:
    both = ("--reference", traverses[0], "--query", traverses[1], "--encoder", "hog", "--json", tmp_path / "out.json")
    right = placerec("evaluate", *both, "--tolerance", 9)
    assert "all right" in right.stdout and "the curve has one class only" in right.stderr
    truth = tmp_path / "truth.csv"
    truth.write_text("0,3\n1,3\n2,3\n3,0\n")
    wrong = placerec("evaluate", *both, "--ground-truth", truth)
    assert "none right" in wrong.stdout and "no best match is right" in wrong.stderr
    figures = json.loads((tmp_path / "out.json").read_text())
    assert (figures["auc_pr"], figures["one_class"]) == (0.0, "none right")  # a number, for those that read one


@pytest.mark.thorough
@pytest.mark.skipif(not CORRIDOR.is_dir(), reason="the corridor traverses (../shared/datasets) are not here")
@pytest.mark.timeout(600)
def test_the_default_encoder_on_the_corridor(placerec: Placerec, tmp_path: Path) -> None:
    figures, rows = evaluated(
        placerec, (CORRIDOR / "ref", CORRIDOR / "query"), tmp_path, "--ground-truth", CORRIDOR / "ground_truth.csv"
    )
    assert len(rows) == 111
    assert figures["auc_pr"] >= 0.75
    assert figures["recall_at"]["1"] >= 0.55
    assert figures["recall_at"]["1"] == pytest.approx(np.mean([matched for _, _, _, matched in rows]))
