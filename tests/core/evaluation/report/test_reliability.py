"""The reliability section: drawn where there are probabilities, absent where not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from core.evaluation import Comparison
from core.evaluation.protocol.trust import trust_figures
from core.evaluation.report import write_report
from core.evaluation.report.reliability import plot_reliability, trust_table
from core.evaluation.report.theme import Cast
from tests.core.evaluation.report.comparisons import make_comparison, read_page


def trusted(folder: Path) -> Comparison:
    comparison = make_comparison(folder, systems=2, count=60, noise=6.0)
    runs = []
    for run in comparison.runs:
        figures = trust_figures(run.scores, comparison.kept, run.outcomes, run.evaluation.notes)
        runs.append(replace(run, evaluation=run.evaluation.model_copy(update=figures)))
    assert all(run.evaluation.trust for run in runs)
    return replace(comparison, runs=runs)


def test_the_diagram_and_its_table(tmp_path: Path) -> None:
    comparison = trusted(tmp_path)
    write_report(tmp_path / "report", comparison)
    page = read_page((tmp_path / "report/index.html").read_text("utf-8"))
    assert "reliability" in [section.attributes.get("id") for section in page.named("section")]
    assert (tmp_path / "report/reliability.png").read_bytes().startswith(b"\x89PNG")
    cast = Cast(comparison.runs)
    plot = plot_reliability(comparison.runs, cast)
    assert plot is not None
    for run, mark in zip(comparison.runs, cast.runs, strict=True):
        assert f"{mark.label} {run.evaluation.ece:.3f}" in plot.alt
    table = read_page(trust_table(comparison.runs, cast))
    cells = [cell.text for cell in table.named("td")]
    first = comparison.runs[0].evaluation.trust
    assert first is not None
    assert cells[1:4] == [
        f"{value:.3f}"
        for value in (first.reliability.ece, first.reliability.brier, first.reliability.brier_of_base_rate)
    ]
    assert f"({first.believed_precision.low:.3f}–{first.believed_precision.high:.3f})" in cells[4]


def test_without_probabilities_there_is_no_section(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path)
    assert plot_reliability(comparison.runs, Cast(comparison.runs)) is None
    assert trust_table(comparison.runs, Cast(comparison.runs)) == ""
    assert np.all([run.evaluation.ece is None for run in comparison.runs])
    write_report(tmp_path / "report", comparison)
    page = read_page((tmp_path / "report/index.html").read_text("utf-8"))
    assert "reliability" not in [section.attributes.get("id") for section in page.named("section")]
