from __future__ import annotations

from pathlib import Path

from core.evaluation.report.curves import plot_pr, plot_recall, plot_roc
from core.evaluation.report.theme import Cast
from tests.core.evaluation.report.comparisons import make_comparison


def test_texts_name_all_systems_and_their_areas(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, systems=3, kept=range(6))
    cast = Cast(comparison.runs)
    for plot, figure in (
        (plot_pr(comparison.runs, cast), "auc_pr"),
        (plot_roc(comparison.runs, cast), "auc_roc"),
        (plot_recall(comparison.runs, cast), None),
    ):
        assert plot is not None
        for run, mark in zip(comparison.runs, cast.runs, strict=True):
            value = run.evaluation.recall_at["1"] if figure is None else getattr(run.evaluation, figure)
            assert f"{mark.label} {value:.3f}" in plot.alt
