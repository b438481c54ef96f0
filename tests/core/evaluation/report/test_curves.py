from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from core.evaluation import auc_pr, auc_roc
from core.evaluation.report.curves import plot_pr, plot_recall, plot_roc, pr_curve, recall_curve, roc_curve
from core.evaluation.report.theme import Cast
from tests.core.evaluation.report.comparisons import make_comparison, outcome


def test_pr_curve_by_hand() -> None:
    outcomes = [outcome(0.9, matched=True), outcome(0.8), outcome(0.7, matched=True), outcome(0.6, negative=True)]
    curve = pr_curve(outcomes)
    assert curve is not None
    recall, precision = curve
    assert recall.tolist() == [0, 0.5, 0.5, 1, 1]
    assert precision == pytest.approx([1, 1, 1 / 2, 2 / 3, 2 / 4])


def test_area_under_the_points_is_the_figure() -> None:
    generator = np.random.default_rng(3)
    for _ in range(20):
        outcomes = [
            outcome(float(score), matched=bool(score + noise > 1), negative=bool(noise < 0.2))
            for score, noise in generator.random((40, 2)).round(1)
        ]
        outcomes = [replace(one, matched=False) if one.rank is None else one for one in outcomes]
        scores, matched = [one.score for one in outcomes], [one.matched for one in outcomes]
        pr, roc = pr_curve(outcomes), roc_curve(outcomes)
        assert pr is not None
        assert roc is not None
        assert np.trapezoid(pr[1], pr[0]) == pytest.approx(auc_pr(scores, matched), abs=1e-12)
        positive = [one.rank is not None for one in outcomes]
        assert np.trapezoid(roc[1], roc[0]) == pytest.approx(auc_roc(scores, positive), abs=1e-12)


def test_one_class_has_no_curve() -> None:
    assert pr_curve([outcome(0.5)]) is None
    assert roc_curve([outcome(0.5, matched=True)]) is None
    assert roc_curve([outcome(0.5, negative=True)]) is None
    assert recall_curve([outcome(0.5, negative=True)], 5) is None


def test_recall_curve_by_hand() -> None:
    outcomes = [replace(outcome(0.5), rank=rank) for rank in (1, 3, 3, None, 9)]
    curve = recall_curve(outcomes, 4)
    assert curve is not None
    assert curve.tolist() == [0.25, 0.25, 0.75, 0.75]


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
