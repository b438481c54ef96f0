"""One system by itself: its similarity matrix, its scores, its matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from core.evaluation.report.drawing import Plot
from core.evaluation.report.gallery import gallery
from core.evaluation.report.matrix import Layers, describe_matrix, heat_file, layers, matrix_file, png, true_cells
from core.evaluation.report.table import swatch
from core.evaluation.report.text import counted, escape, number
from core.evaluation.report.theme import Mark
from core.evaluation.report.threshold_effects import plot_fates
from core.evaluation.report.thumbnails import Thumbnails, data_uri

if TYPE_CHECKING:
    from core.evaluation.protocol.comparison import Comparison, Run
    from core.evaluation.protocol.thresholds import Thresholding

RULES = {
    "mean_of_negatives": "the mean score of the queries without a true reference",
    "full_precision": "the best score of a wrong match",
}


@dataclass(frozen=True)
class Closeup:
    """The section of a run, and its files by their names."""

    html: str
    files: dict[str, bytes]


def closeup(comparison: Comparison, run: Run, mark: Mark, stem: str, thumbnails: Thumbnails) -> Closeup:
    """Everything about one run.

    Args:
        stem: what the names of its files end in.
    """
    drawn = layers(
        run.scores,
        true_cells(comparison.truth, comparison.kept),
        comparison.kept,
        run.outcomes,
        longest=640 if len(comparison.runs) <= 6 else 448,
    )
    rule = run.evaluation.thresholds[0] if run.evaluation.thresholds else None
    fates = plot_fates(stem, mark.label, run.outcomes, None if rule is None else rule.threshold)
    shape = run.scores.shape[:2]
    own = comparison.regions_of in (None, run.identity)
    cases = gallery(
        comparison,
        run,
        thumbnails,
        comparison.regions if own else None,
        most=min(12, max(4, 36 // len(comparison.runs) * 2)),
    )
    parts = [
        f'<h3 id="run-{mark.place}-title">{swatch(mark)}{escape(mark.label)}</h3>',
        _about(run),
        '<div class="pair">',
        _matrix(drawn, describe_matrix(mark.label, shape), run),
        f"<div>{''.join(embed(plot) for plot in fates)}{_counts(run.evaluation.thresholds)}</div>",
        "</div>",
        cases,
    ]
    id = f"run-{mark.place}"
    html = f'<section class="run" id="{id}" aria-labelledby="{id}-title">{"".join(parts)}</section>'
    files = {f"similarity-{stem}.png": matrix_file(mark.label, drawn, shape)}
    return Closeup(html, files | {f"{plot.name}.png": plot.light for plot in fates})


def embed(plot: Plot) -> str:
    """A plot inside the page, in the colours that the reader prefers."""
    light, dark = (data_uri(data, "image/png") for data in (plot.light, plot.dark))
    return (
        f'<figure class="plot"><picture><source media="(prefers-color-scheme: dark)" srcset="{dark}">'
        f'<img src="{light}" alt="{escape(plot.alt)}" width="{plot.width}" height="{plot.height}"></picture></figure>'
    )


def _about(run: Run) -> str:
    """What the system is; its constants are folded away."""
    trained = run.evaluation.trained_on
    rows = [(name, _constant(value)) for name, value in run.about.configuration.items()]
    rows += [("trained on", trained)] if trained else []
    constants = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in rows)
    return (
        f'<p class="quiet">{escape(run.about.paper.rstrip("."))}.</p>'
        '<details class="quiet"><summary>How it was set up</summary>'
        f"<dl>{constants}<dt>identity</dt><dd><code>{escape(run.identity)}</code></dd></dl></details>"
    )


def _constant(value: object) -> str:
    return " ".join(str(item) for item in value) if isinstance(value, tuple | list) else str(value)


def _matrix(drawn: Layers, alt: str, run: Run) -> str:
    """Three drawings one over the other; the switches hide the upper two, without a script."""
    height, width = drawn.heat.shape
    layered = [
        f'<img src="{data_uri(*heat_file(drawn))}" alt="{escape(alt)}" width="{width}" height="{height}">',
        f'<img class="layer-truth" src="{data_uri(png(drawn.truth), "image/png")}" alt="">',
        f'<img class="layer-matches" src="{data_uri(png(drawn.matches), "image/png")}" alt="">',
    ]
    queries, references = run.scores.shape
    return (
        '<figure class="matrix">'
        '<label class="switch truth-switch"><input type="checkbox" checked> <i class="key-truth"></i>true '
        "references</label>"
        '<label class="switch matches-switch"><input type="checkbox" checked> <i class="key-right"></i>right and '
        '<i class="key-wrong"></i>wrong best matches</label>'
        f'<div class="axes"><span class="down">{counted(queries, "query")}</span>'
        f'<span class="across">{counted(references, "kept reference")}</span>'
        f'<div class="stack">{"".join(layered)}</div></div>'
        "<figcaption>Each row is a query, each column a reference; the brighter, the more alike.</figcaption></figure>"
    )


def _counts(thresholds: Sequence[Thresholding]) -> str:
    """TP, FP, FN and TN before and after each threshold; empty where none is defined."""
    if not thresholds:
        return '<p class="quiet">No match is wrong and no query lacks a true reference: there is nothing to reject.</p>'
    first = thresholds[0].before
    rows = [("nothing is rejected", first)]
    rows += [(f"over {number(one.threshold)}, {RULES[one.rule]}", one.after) for one in thresholds]
    body = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{one.true_positives}</td><td>{one.false_positives}</td>'
        f"<td>{one.false_negatives}</td><td>{one.true_negatives}</td></tr>"
        for name, one in rows
    )
    return (
        '<table class="counts"><thead><tr><th scope="col">Accepted</th><th scope="col" title="true positives">TP</th>'
        '<th scope="col" title="false positives">FP</th><th scope="col" title="false negatives">FN</th>'
        f'<th scope="col" title="true negatives">TN</th></tr></thead><tbody>{body}</tbody></table>'
    )
