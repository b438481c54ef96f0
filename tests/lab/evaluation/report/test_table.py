from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from core.frames.traverses import tolerance_truth
from lab.evaluation.report.table import columns, stages
from tests.lab.evaluation.report.comparisons import Written, make_comparison, make_run, written_page


def test_columns_without_any_figure_are_left_out(tmp_path: Path) -> None:
    all_positive = make_comparison(tmp_path, systems=1).runs
    assert "AUC-ROC" not in [column.heading for column in columns(all_positive)]
    with_negatives = make_comparison(tmp_path, systems=1, retained=range(6)).runs
    assert "AUC-ROC" in [column.heading for column in columns(with_negatives)]


def test_stages_of_all_systems_matching_last(tmp_path: Path) -> None:
    first, second = make_comparison(tmp_path, systems=2).runs
    runs = [
        replace(first, milliseconds={"match": 1.0, "forward": 2.0, "words": None}),
        replace(second, milliseconds={"gradients": 1.0, "regions": 3.0, "match": 1.0}),
    ]
    assert stages(runs) == ["forward", "regions", "gradients", "match"]


@pytest.mark.thorough
def test_best_figure_of_a_column_stands_out(tmp_path: Path) -> None:
    retained, truth = np.arange(3), tolerance_truth(3, 3, 0)
    good = make_run("good", np.eye(3, dtype=np.float32), retained, truth, nbytes=9000)
    poor = make_run("poor", np.array([[1, 0, 0], [2, 0, 0], [0, 0, 1]], np.float32), retained, truth, nbytes=10)
    comparison = make_comparison(tmp_path, systems=1, count=3)
    page = written_page(tmp_path / "two", replace(comparison, runs=[good, poor]))
    best = [cell.text for cell in page.named("td", "best")]
    assert best[0] == "1.000 all right"
    assert best[-1] == "10\N{NO-BREAK SPACE}B", "less memory is better"
    assert "9.0\N{NO-BREAK SPACE}KB" not in best
    assert not written_page(tmp_path / "one", replace(comparison, runs=[good])).named("td", "best")


@pytest.mark.thorough
def test_a_missing_figure_cannot_be_mistaken_for_a_number(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, systems=2)
    first, second = comparison.runs
    page = written_page(tmp_path / "report", replace(comparison, runs=[first, replace(second, milliseconds={})]))
    missing = page.named("td", "none")
    assert [cell.text for cell in missing] == ["–"] * 3  # total, forward, match
    assert all("data-value" not in cell.attributes for cell in missing)


def test_sorted_as_it_comes(written: Written) -> None:
    page = written.page
    sorted_heads = [head for head in page.named("th") if "aria-sort" in head.attributes]
    assert [(head.text, head.attributes["aria-sort"]) for head in sorted_heads] == [("AUC-PR", "descending")]
    assert len(page.named("button")) == len(columns(written.comparison.runs)) + 1


def test_what_was_not_measured_is_a_dash() -> None:
    """A run whose scores were computed elsewhere has no memory beside one that has."""
    retained = np.arange(2)
    ours = make_run("ours", np.eye(2, dtype=np.float32), retained, tolerance_truth(2, 2, 0))
    theirs = replace(ours, bytes_per_place=None, elsewhere=True)
    (memory,) = [column for column in columns([ours, theirs]) if column.group == "Memory"]
    assert [memory.form(memory.value(run)) for run in (ours, theirs)] == ["1.5\N{NO-BREAK SPACE}KB", "–"]
