"""Precision–recall and ROC curves of all systems together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from core.evaluation.protocol.figures import recall_at_k
from core.evaluation.protocol.outcomes import answerable, best_matched, best_scores, has_true_reference
from core.evaluation.report.drawing import EndLabel, Margins, Plot, Sheet, label_ends, render, shares
from core.evaluation.report.text import enumerate_words, number
from core.evaluation.report.theme import Cast, Mark, Theme
from core.judgement.curves import Curve, pr_curve, roc_curve

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from core.evaluation.protocol.comparison import Run


def plot_pr(runs: Sequence[Run], cast: Cast) -> Plot | None:
    """Each system's precision over its recall, named where its curve ends; None where no system has a right match."""
    drawn = [
        (mark, curve, run.evaluation.auc_pr)
        for run, mark in zip(runs, cast.runs, strict=True)
        if (curve := pr_curve(best_scores(run.outcomes), best_matched(run.outcomes))) is not None
    ]
    if not drawn:
        return None
    sheet = _sheet("Precision over recall", len(drawn))

    def paint(axes: Axes, theme: Theme) -> None:
        shares(axes, x=True, y=True)
        axes.set(xlabel="recall, of right matches", ylabel="precision")
        _draw(axes, theme, [(mark, curve) for mark, curve, _ in drawn])
        ends = [EndLabel(mark, float(y[-1]), number(area)) for mark, (_, y), area in drawn]
        label_ends(axes, theme, sheet, ends)

    areas = [f"{mark.label} {number(area)}" for mark, _, area in drawn]
    return render("pr", f"Precision–recall curves. Area under each: {enumerate_words(areas)}.", sheet, paint)


def plot_roc(runs: Sequence[Run], cast: Cast) -> Plot | None:
    """Each system's true over its false positive rate, the largest area first in the key; None without negatives."""
    drawn = [
        (mark, curve, run.evaluation.auc_roc)
        for run, mark in zip(runs, cast.runs, strict=True)
        if (curve := roc_curve(best_scores(run.outcomes), has_true_reference(run.outcomes))) is not None
    ]
    if not drawn:
        return None
    sheet = _sheet("True over false positives (ROC)", len(drawn))
    drawn.sort(key=lambda entry: -(entry[2] or 0.0))

    def paint(axes: Axes, theme: Theme) -> None:
        shares(axes, x=True, y=True)
        axes.set(xlabel="negatives accepted", ylabel="positives accepted")
        axes.plot([0, 1], [0, 1], color=theme.muted, linewidth=0.8, linestyle=(0, (2, 3)))
        _draw(axes, theme, [(mark, curve) for mark, curve, _ in drawn])
        # All these curves end in one point, so the names stand as a key, in the order of the areas.
        key = [EndLabel(mark, 1.0 - index * 1e-6, number(area)) for index, (mark, _, area) in enumerate(drawn)]
        label_ends(axes, theme, sheet, key, leaders=False)

    areas = [f"{mark.label} {number(area)}" for mark, _, area in drawn]
    return render("roc", f"ROC curves. Area under each: {enumerate_words(areas)}.", sheet, paint)


def plot_recall(runs: Sequence[Run], cast: Cast) -> Plot | None:
    """Recall over how many best matches are looked at; None unless there is a choice of two."""
    depths = min(25, runs[0].scores.shape[1])
    drawn = [
        (mark, np.array([recall_at_k(run.outcomes, k) for k in range(1, depths + 1)], np.float64))
        for run, mark in zip(runs, cast.runs, strict=True)
        if answerable(run.outcomes)
    ]
    if not drawn or depths < 2:
        return None
    sheet = _sheet("Recall among the best N", len(drawn))
    depth = np.arange(1, depths + 1, dtype=np.float64)

    def paint(axes: Axes, theme: Theme) -> None:
        shares(axes, x=False, y=True)
        axes.set(xlabel="N best matches", ylabel="recall@N", xlim=(1, depths))
        axes.set_xticks(sorted({1, *(tick for tick in (5, 10, 15, 20, 25) if tick <= depths)}))
        _draw(axes, theme, [(mark, (depth, curve)) for mark, curve in drawn])
        label_ends(
            axes, theme, sheet, [EndLabel(mark, float(curve[-1]), number(float(curve[-1]))) for mark, curve in drawn]
        )

    said = [f"{mark.label} {number(float(curve[0]))} to {number(float(curve[-1]))}" for mark, curve in drawn]
    alt = f"Recall among the best matches, from recall@1 to recall@{depths}: {enumerate_words(said)}."
    return render("recall", alt, sheet, paint)


def _sheet(title: str, lines: int) -> Sheet:
    return Sheet(title, height=max(380, 15 * lines + 90), margins=Margins(right=206))


def _draw(axes: Axes, theme: Theme, curves: Sequence[tuple[Mark, Curve]]) -> None:
    """The best system lies on top."""
    for mark, (x, y) in sorted(curves, key=lambda curve: -curve[0].place):
        axes.plot(x, y, color=mark.color(theme), linestyle=mark.linestyle, linewidth=mark.width, alpha=mark.alpha)
