from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lab.evaluation import SystemComparison
from lab.evaluation.protocol.trust import trust_figures
from lab.evaluation.report.curves import plot_pr, plot_recall, plot_reliability, plot_roc
from lab.evaluation.report.theme import Cast
from tests.lab.evaluation.report.comparisons import Written, make_comparison


def test_texts_name_all_systems_and_their_areas(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, systems=3, retained=range(6))
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


# The reliability section: drawn where there are probabilities, absent where not


def with_probabilities(folder: Path) -> SystemComparison:
    comparison = make_comparison(folder, systems=2, count=60, noise=6.0)
    runs = []
    for run in comparison.runs:
        figures = trust_figures(run.scores, comparison.retained, run.outcomes, run.evaluation.notes)
        runs.append(replace(run, evaluation=run.evaluation.model_copy(update=figures)))
    assert all(run.evaluation.trust for run in runs)
    return replace(comparison, runs=runs)


def test_without_probabilities_there_is_no_section(written: Written) -> None:
    runs = written.comparison.runs
    assert plot_reliability(runs, Cast(runs)) is None
    assert "reliability" not in [section.attributes.get("id") for section in written.page.named("section")]
