"""``placerec evaluate`` on results and similarities that were saved before."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import auc, precision_recall_curve

from tests.service.commands.conftest import Placerec

RANDOM = np.random.default_rng(5)


def test_results_without_a_header(placerec: Placerec, tmp_path: Path) -> None:
    scores = RANDOM.choice(np.linspace(0, 1, 20), 200).tolist()  # ties
    matched = [bool(RANDOM.random() < score) for score in scores]
    path, out = tmp_path / "theirs.csv", tmp_path / "out.json"
    rows = enumerate(zip(scores, matched, strict=True))
    path.write_text("".join(f"{query},{query + 3},{score},{float(right)}\n" for query, (score, right) in rows))

    shown = placerec("evaluate", "--from-results", path, "--json", out)

    figures = json.loads(out.read_text())
    precision, recall, _ = precision_recall_curve(matched, scores)
    assert figures["auc_pr"] == pytest.approx(auc(recall, precision), abs=1e-6)
    assert (figures["encoder"], figures["queries"], figures["right"]) == ("theirs.csv", 200, sum(matched))
    assert figures["recall_at"] == {"1": None, "5": None, "10": None}
    assert f"{figures['auc_pr']:.3f}" in shown.stdout
    assert "does not say which queries have a true reference" in shown.stderr


@pytest.mark.parametrize(("matched", "word"), [(1, "all right"), (0, "none right")])
def test_results_of_one_class_have_a_word(placerec: Placerec, tmp_path: Path, matched: int, word: str) -> None:
    path = tmp_path / "one.csv"
    path.write_text(f"query,retrieved,score,matched\n0,1,0.5,{matched}\n1,2,0.25,{matched}\n")
    assert word in placerec("evaluate", "--from-results", path).stdout


def test_several_files_are_compared(placerec: Placerec, tmp_path: Path) -> None:
    for name, first in (("a.csv", 1), ("b.csv", 0)):
        (tmp_path / name).write_text(f"0,1,0.5,{first}\n1,2,0.25,1\n")
    words = ("--from-results", tmp_path / "a.csv", "--from-results", tmp_path / "b.csv", "--json", tmp_path / "o.json")
    placerec("evaluate", *words)
    figures = json.loads((tmp_path / "o.json").read_text())
    assert [one["encoder"] for one in figures["encoders"]] == ["a.csv", "b.csv"]
    assert figures["auc_pr"] == 1.0


def saved_matrix(folder: Path) -> tuple[Path, Path]:
    """Three queries against five references: right, wrong and, with references 0 to 3 retained, a new place."""
    matrix = np.full((3, 5), 0.1)
    matrix[0, 1], matrix[1, 0], matrix[2, 4] = 0.9, 0.8, 0.7
    np.save(folder / "matrix.npy", matrix)
    (folder / "truth.csv").write_text("query,reference\n0,1\n1,2\n2,4\n")
    return folder / "matrix.npy", folder / "truth.csv"


def test_a_matrix_and_a_truth(placerec: Placerec, tmp_path: Path) -> None:
    matrix, truth = saved_matrix(tmp_path)
    out, rows = tmp_path / "out.json", tmp_path / "rows.csv"
    words = ("--from-similarity", matrix, "--ground-truth", truth, "--json", out, "--results", rows)
    placerec("evaluate", *words)
    figures = json.loads(out.read_text())
    # Best first: right, wrong, right: as worked out in test_figures.
    assert figures["auc_pr"] == pytest.approx(0.5 + 7 / 24)
    assert figures["recall_at"]["1"] == pytest.approx(2 / 3)
    assert (figures["queries"], figures["references"]) == (3, 5)
    assert rows.read_text().splitlines()[1:] == ["0,1,0.9,1", "1,0,0.8,0", "2,4,0.7,1"]

    (tmp_path / "retained.txt").write_text("0\n1\n2\n3\n")
    shown = placerec("evaluate", *words, "--limit-references", tmp_path / "retained.txt")
    figures = json.loads(out.read_text())
    assert (figures["negatives"], figures["auc_roc"]) == (1, 1.0)
    assert "mean of true negatives" in shown.stdout


def test_similarities_are_compared_as_they_were_saved(placerec: Placerec, tmp_path: Path) -> None:
    """Of scores that single precision cannot tell apart, the higher one is found, and written whole."""
    matrix = np.full((2, 2), 1 - 2e-9)
    matrix[0, 0] = matrix[1, 1] = 1 - 1e-9
    np.save(tmp_path / "close.npy", matrix)
    rows = tmp_path / "rows.csv"
    placerec("evaluate", "--from-similarity", tmp_path / "close.npy", "--tolerance", 0, "--results", rows)
    assert rows.read_text().splitlines()[1:] == ["0,0,0.999999999,1", "1,1,0.999999999,1"]


def test_rows_of_files_of_one_name_are_not_written_over(placerec: Placerec, tmp_path: Path) -> None:
    paths = [tmp_path / name / "matrix.npy" for name in ("a", "b")]
    for path in paths:
        path.parent.mkdir()
        np.save(path, np.eye(2))
    words = ("--from-similarity", paths[0], "--from-similarity", paths[1], "--tolerance", 0)
    placerec("evaluate", *words)
    said = placerec("evaluate", *words, "--results", tmp_path / "rows.csv", status=2).stderr
    assert "files of different names" in " ".join(said.replace("│", "").split())


def test_a_matrix_the_other_way_round(placerec: Placerec, tmp_path: Path) -> None:
    matrix, truth = saved_matrix(tmp_path)
    np.save(tmp_path / "turned.npy", np.load(matrix).T)
    words = ("--ground-truth", truth, "--json", tmp_path / "out.json")
    placerec("evaluate", "--from-similarity", tmp_path / "turned.npy", "--transposed", *words)
    turned = json.loads((tmp_path / "out.json").read_text())
    placerec("evaluate", "--from-similarity", matrix, *words)
    assert {**turned, "encoder": "", "encoders": []} == {
        **json.loads((tmp_path / "out.json").read_text()),
        "encoder": "",
        "encoders": [],
    }
    refused = placerec("evaluate", "--from-similarity", tmp_path / "turned.npy", *words, status=1).stderr
    assert "read as 5 queries by 3 references; --transposed turns it" in refused.replace("\n", " ")


def test_what_does_not_go_together_is_refused(placerec: Placerec, tmp_path: Path) -> None:
    matrix, truth = saved_matrix(tmp_path)
    results = tmp_path / "results.csv"
    results.write_text("0,1,0.5,1\n")
    placerec("evaluate", "--from-results", results, "--from-similarity", matrix, status=2)
    said = placerec("evaluate", "--from-similarity", matrix, status=2).stderr
    assert "--ground-truth or --tolerance" in said and "--poses" not in said
    placerec("evaluate", "--from-similarity", matrix, "--ground-truth", truth, "--tolerance", 1, status=2)
    said = placerec("evaluate", "--from-results", results, "--encoder", "hog", "--report", tmp_path, status=2).stderr
    assert "--encoder" in said and "--report" in said
    placerec("evaluate", "--from-results", results, "--ground-truth", truth, status=2)
    placerec("evaluate", "--from-results", results, "--transposed", status=2)
    placerec("evaluate", "--from-similarity", matrix, "--poses", "--metres", 5, status=2)
    placerec("evaluate", "--from-similarity", matrix, "--ground-truth", truth, "--reference", tmp_path, status=2)
    assert "cannot be read" in placerec("evaluate", "--from-results", tmp_path / "no.csv", status=1).stderr
