"""The reliability diagram: what was promised, and what came of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from core.evaluation.report.drawing import EndLabel, Margins, Plot, Sheet, label_ends, render, shares
from core.evaluation.report.text import MISSING, enumerate_words, escape, number
from core.evaluation.report.theme import Cast, Mark, Theme

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from core.evaluation.protocol.comparison import Run
    from core.evaluation.protocol.trust import Trust
    from core.judgement.reliability import Share

HEADINGS = ("system", "right against wrong, AUC-ROC", "ECE", "Brier", "of the base rate", "P at 95 %", "R at 95 %")


def _trusted(runs: Sequence[Run], cast: Cast) -> list[tuple[Mark, Trust]]:
    pairs = zip(runs, cast.runs, strict=True)
    return [(mark, found) for run, mark in pairs if (found := run.evaluation.trust) is not None]


def plot_reliability(runs: Sequence[Run], cast: Cast) -> Plot | None:
    """Share of right answers over their probability, a point a bin; None where no system has probabilities."""
    drawn = _trusted(runs, cast)
    if not drawn:
        return None
    sheet = Sheet(
        "Right answers over their probability", height=max(380, 15 * len(drawn) + 90), margins=Margins(right=206)
    )

    def paint(axes: Axes, theme: Theme) -> None:
        shares(axes, x=True, y=True)
        axes.set(xlabel="probability, mean of a bin", ylabel="share that is right")
        axes.plot([0, 1], [0, 1], color=theme.muted, linewidth=0.8, linestyle=(0, (2, 3)))
        for mark, found in reversed(drawn):  # the best system lies on top
            bins = found.reliability.bins
            x, y = [one.probability for one in bins], [one.right.value or 0.0 for one in bins]
            axes.plot(
                x,
                y,
                color=mark.color(theme),
                linestyle=mark.linestyle,
                linewidth=mark.width,
                alpha=mark.alpha,
                marker="o",
                markersize=3.5,
            )
        mark, found = drawn[0]
        for one in found.reliability.bins:
            axes.plot([one.probability] * 2, [one.right.low, one.right.high], color=mark.color(theme), linewidth=0.9)
        # The lines may end anywhere, so the names stand as a key.
        key = [
            EndLabel(mark, 1.0 - index * 1e-6, number(found.reliability.ece))
            for index, (mark, found) in enumerate(drawn)
        ]
        label_ends(axes, theme, sheet, key, leaders=False)

    errors = [f"{mark.label} {number(found.reliability.ece)}" for mark, found in drawn]
    return render("reliability", f"Reliability. Calibration error of each: {enumerate_words(errors)}.", sheet, paint)


def _interval(share: Share) -> str:
    if share.value is None:
        return f"<td>{MISSING}</td>"
    return f"<td>{number(share.value)} <small>({number(share.low)}–{number(share.high)})</small></td>"


def trust_table(runs: Sequence[Run], cast: Cast) -> str:
    """The figures of the diagram, as HTML; "" where there are none."""
    rows = []
    for mark, found in _trusted(runs, cast):
        worth = found.reliability
        plain = (found.auc_roc_right, worth.ece, worth.brier, worth.brier_of_base_rate)
        cells = "".join(f"<td>{number(value)}</td>" for value in plain)
        shares_told = _interval(found.believed_precision) + _interval(found.believed_recall)
        rows.append(f'<tr><th scope="row">{escape(mark.label)}</th>{cells}{shares_told}</tr>')
    if not rows:
        return ""
    head = "".join(f'<th scope="col">{heading}</th>' for heading in HEADINGS)
    body = f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<div class="wide" tabindex="0" role="region" aria-label="Trust"><table>{body}</table></div>'
