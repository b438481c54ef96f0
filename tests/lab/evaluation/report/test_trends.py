from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from lab.evaluation.report.theme import Cast
from lab.evaluation.report.trends import plot_cost, time_per_query
from tests.lab.evaluation.report.comparisons import make_comparison


def test_time_per_query_is_all_stages(tmp_path: Path) -> None:
    run = make_comparison(tmp_path, systems=1).runs[0]
    assert time_per_query(run) == pytest.approx(4.75)
    assert time_per_query(replace(run, milliseconds={"forward": None})) is None
    described = replace(run, evaluation=run.evaluation.model_copy(update={"describe_milliseconds": 9.0}))
    assert time_per_query(described) == pytest.approx(9.5), "what is measured whole is not summed from its stages"


def test_cost_needs_two_systems(tmp_path: Path) -> None:
    runs = make_comparison(tmp_path, systems=2).runs
    cast = Cast(runs)
    assert plot_cost(runs[:1], Cast(runs[:1])) is None
    plot = plot_cost(runs, cast)
    assert plot is not None
    for run, mark in zip(runs, cast.runs, strict=True):
        assert f"{mark.label} {run.evaluation.auc_pr:.3f} at 4.8 ms" in plot.alt
