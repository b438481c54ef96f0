"""Precision–recall, ROC, recall and reliability curves of all systems together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from core.judgement.curves import pr_curve, roc_curve
from lab.evaluation.protocol.figures import recall_at_k
from lab.evaluation.protocol.outcomes import answerable, best_matched, best_scores, has_true_reference
from lab.evaluation.report.charts import Chart, draw, plot_line, shares
from lab.evaluation.report.text import enumerate_words, number
from lab.evaluation.report.theme import LIGHT, Cast, Mark

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from lab.evaluation.protocol.comparison import SystemRun
    from lab.evaluation.protocol.trust import Trust


def plot_pr(runs: Sequence[SystemRun], cast: Cast) -> Chart | None:
    """Each system's precision over its recall; None where no system has a right match."""
    drawn = [
        (mark, curve, run.evaluation.auc_pr)
        for run, mark in zip(runs, cast.runs, strict=True)
        if (curve := pr_curve(best_scores(run.outcomes), best_matched(run.outcomes))) is not None
    ]
    if not drawn:
        return None

    def paint(axes: Axes) -> None:
        shares(axes, x=True, y=True)
        axes.set(xlabel="recall, of right matches", ylabel="precision")
        for mark, (x, y), area in drawn:
            plot_line(axes, mark, x, y, number(area))

    areas = [f"{mark.label} {number(area)}" for mark, _, area in drawn]
    alt = f"Precision–recall curves. Area under each: {enumerate_words(areas)}."
    return draw("pr", alt, "Precision over recall", paint, height_for(drawn))


def plot_roc(runs: Sequence[SystemRun], cast: Cast) -> Chart | None:
    """Each system's true over its false positive rate, the largest area first in the key; None without negatives."""
    drawn = [
        (mark, curve, run.evaluation.auc_roc)
        for run, mark in zip(runs, cast.runs, strict=True)
        if (curve := roc_curve(best_scores(run.outcomes), has_true_reference(run.outcomes))) is not None
    ]
    if not drawn:
        return None
    drawn.sort(key=lambda entry: -(entry[2] or 0.0))

    def paint(axes: Axes) -> None:
        shares(axes, x=True, y=True)
        axes.set(xlabel="negatives accepted", ylabel="positives accepted")
        _diagonal(axes)
        for mark, (x, y), area in drawn:
            plot_line(axes, mark, x, y, number(area))

    areas = [f"{mark.label} {number(area)}" for mark, _, area in drawn]
    alt = f"ROC curves. Area under each: {enumerate_words(areas)}."
    return draw("roc", alt, "True over false positives (ROC)", paint, height_for(drawn))


def plot_recall(runs: Sequence[SystemRun], cast: Cast) -> Chart | None:
    """Recall over how many best matches are looked at; None unless there is a choice of two."""
    depths = min(25, runs[0].scores.shape[1])
    drawn = [
        (mark, np.array([recall_at_k(run.outcomes, k) for k in range(1, depths + 1)], np.float64))
        for run, mark in zip(runs, cast.runs, strict=True)
        if answerable(run.outcomes)
    ]
    if not drawn or depths < 2:
        return None

    def paint(axes: Axes) -> None:
        shares(axes, x=False, y=True)
        axes.set(xlabel="N best matches", ylabel="recall@N", xlim=(1, depths))
        axes.set_xticks(sorted({1, *(tick for tick in (5, 10, 15, 20, 25) if tick <= depths)}))
        for mark, curve in sorted(drawn, key=lambda entry: -entry[1][-1]):  # the legend in the order of the ends
            plot_line(axes, mark, range(1, depths + 1), curve, number(float(curve[-1])))

    said = [f"{mark.label} {number(float(curve[0]))} to {number(float(curve[-1]))}" for mark, curve in drawn]
    alt = f"Recall among the best matches, from recall@1 to recall@{depths}: {enumerate_words(said)}."
    return draw("recall", alt, "Recall among the best N", paint, height_for(drawn))


def trusted(runs: Sequence[SystemRun], cast: Cast) -> list[tuple[Mark, Trust]]:
    """The systems whose answers have probabilities."""
    pairs = zip(runs, cast.runs, strict=True)
    return [(mark, found) for run, mark in pairs if (found := run.evaluation.trust) is not None]


def plot_reliability(runs: Sequence[SystemRun], cast: Cast) -> Chart | None:
    """Share of right answers over their probability, a point a bin; None where no system has probabilities."""
    drawn = trusted(runs, cast)
    if not drawn:
        return None

    def paint(axes: Axes) -> None:
        shares(axes, x=True, y=True)
        axes.set(xlabel="probability, mean of a bin", ylabel="share that is right")
        _diagonal(axes)
        for mark, found in drawn:
            bins = found.reliability.bins
            x, y = [one.probability for one in bins], [one.right.value or 0.0 for one in bins]
            plot_line(axes, mark, x, y, number(found.reliability.ece), marker="o", markersize=3.5)
        mark, found = drawn[0]
        for one in found.reliability.bins:
            axes.plot([one.probability] * 2, [one.right.low, one.right.high], color=mark.color(LIGHT), linewidth=0.9)

    errors = [f"{mark.label} {number(found.reliability.ece)}" for mark, found in drawn]
    alt = f"Reliability. Calibration error of each: {enumerate_words(errors)}."
    return draw("reliability", alt, "Right answers over their probability", paint, height_for(drawn))


def height_for(lines: Sequence[object], least: int = 380) -> int:
    """Pixels of the page that a chart with this number of lines needs for its legend."""
    return max(least, 16 * len(lines) + 90)


def _diagonal(axes: Axes) -> None:
    axes.plot([0, 1], [0, 1], color=LIGHT.muted, linewidth=0.8, linestyle=(0, (2, 3)))
