from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from lab.evaluation import ScalePoint, SeverityCurve, SizePoint
from lab.evaluation.report.theme import Cast
from lab.evaluation.report.trends import plot_cost, plot_map_sizes, plot_scalability, plot_severity, time_per_query
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


@pytest.mark.thorough
def test_scalability_sorts_its_points(tmp_path: Path) -> None:
    cast = Cast(make_comparison(tmp_path, systems=2).runs)
    points = [
        ScalePoint("system-0", 100, 90, 0.5, None, 20.0),
        ScalePoint("system-0", 10, 10, 0.75, 1.0, 0.5),
        ScalePoint("system-1", 100, 90, 0.25, 0.5, 2.0),
    ]
    plots = {plot.name: plot.alt for plot in plot_scalability(points, cast)}
    assert list(plots) == ["scalability-auc-pr", "scalability-recall", "scalability-time"]
    assert "system-0 from 0.750 at 10 to 0.500 at 100" in plots["scalability-auc-pr"]
    assert "system-0 from 1.000 at 10 to 1.000 at 10" in plots["scalability-recall"]
    assert "system-0 from 0.50 at 10 to 20 at 100" in plots["scalability-time"]


@pytest.mark.thorough
def test_sizes_without_strangers_have_no_error(tmp_path: Path) -> None:
    cast = Cast(make_comparison(tmp_path, systems=1).runs)
    points = [
        SizePoint("system-0", 1, 5, 60, 0.25, 0.05, 0.2),
        SizePoint("system-0", 10, 20, 60, 0.5, 0.0, 0.1),
        SizePoint("system-0", 111, 20, 0, 0.75, None, None),
    ]
    plots = {plot.name: plot.alt for plot in plot_map_sizes(points, cast)}
    assert list(plots) == ["sizes-error", "sizes-known", "sizes-strangers"]
    assert "from 0.200 at 1 to 0.100 at 10" in plots["sizes-error"]
    assert "from 0.250 at 1 to 0.750 at 111" in plots["sizes-known"]
    assert "from 0.050 at 1 to 0.000 at 10" in plots["sizes-strangers"]
    assert plot_map_sizes([], cast) == []
    verified = [SizePoint("system-0", n, 5, 60, 0.25, 0.05, 0.2, 0.75, 0.0, 0.1) for n in (1, 10)]
    plots = {plot.name: plot.alt for plot in plot_map_sizes(verified, cast)}
    assert list(plots)[3:] == ["verified-error", "verified-known", "verified-strangers"]
    assert "from 0.750 at 1 to 0.750 at 10" in plots["verified-known"]


@pytest.mark.thorough
def test_two_plots_for_each_disturbance(tmp_path: Path) -> None:
    cast = Cast(make_comparison(tmp_path, systems=2).runs)
    curves = [
        SeverityCurve(disturbance, system, [0.0, 0.5, 1.0], unit, [1.0, 0.9, last], [0.9, 0.8, 2 * last])
        for disturbance, unit in (("lateral shift", "of the width"), ("noise", ""))
        for system, last in (("system-0", 0.25), ("system-1", 0.125))
    ]
    plots = plot_severity(curves, cast)
    assert [plot.name for plot in plots] == [
        "severity-lateral-shift",
        "severity-lateral-shift-recall",
        "severity-noise",
        "severity-noise-recall",
    ]
    assert plots[0].alt.startswith("Lateral shift: AUC-PR over lateral shift, of the width.")
    assert plots[3].alt.startswith("Noise, recall@1: recall@1 over noise.")
    for plot, first, last in zip(plots, (0.9, 1.0) * 2, (0.5, 0.25) * 2, strict=True):
        assert f"system-0 from {first:.3f} at 0 to {last:.3f} at 1" in plot.alt
        assert f"system-1 from {first:.3f} at 0 to {last / 2:.3f} at 1" in plot.alt
