from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from core.frames.traverses import tolerance_truth
from lab.evaluation.report.table import columns, stages
from tests.lab.evaluation.report.comparisons import Written, make_comparison, make_run


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
