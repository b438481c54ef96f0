"""Accuracy against what varies: time per query, number of references, strength of a disturbance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from core.evaluation.report.drawing import (
    EndLabel,
    Margins,
    Plot,
    Sheet,
    label_ends,
    plain_log_ticks,
    render,
    shares,
)
from core.evaluation.report.labels import Name, place_labels
from core.evaluation.report.text import enumerate_words, file_stems, milliseconds, number, plain
from core.evaluation.report.theme import Cast, Mark, Theme, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from core.evaluation.protocol.comparison import Run, ScalePoint, SeverityCurve


SHORTEST = 1e-3
"""Milliseconds: shorter times are drawn as this, for an axis by factors has no zero."""


@dataclass(frozen=True)
class Line:
    """One system's points, by rising x."""

    mark: Mark
    x: Sequence[float]
    y: Sequence[float]


def time_per_query(run: Run) -> float | None:
    """Milliseconds of all stages of one query, the image's decoding left out; None where none was measured."""
    stages = {stage: time for stage, time in run.milliseconds.items() if time is not None}
    describing = run.evaluation.describe_milliseconds
    if describing is not None:
        return describing + stages.get("match", 0.0)
    return sum(stages.values()) if stages else None


def plot_cost(runs: Sequence[Run], cast: Cast) -> Plot | None:
    """Accuracy over the time of a query; None unless two systems have both."""
    points = [
        (mark, time, run.evaluation.auc_pr)
        for run, mark in zip(runs, cast.runs, strict=True)
        if (time := time_per_query(run)) is not None and time > 0
    ]
    if len(points) < 2:
        return None
    sheet = Sheet("Accuracy and time")

    def paint(axes: Axes, theme: Theme) -> None:
        times, areas = [time for _, time, _ in points], [area for _, _, area in points]
        air = 0.12 * (max(areas) - min(areas)) or 0.1
        axes.set_ylim(max(0, min(areas) - air), min(1.015, max(areas) + air))
        axes.set(xlabel="milliseconds per query, all stages", ylabel="AUC-PR")
        axes.set_xscale("log")
        axes.set_xlim(min(times) / 1.6, max(times) * 2.6)
        plain_log_ticks(axes.xaxis)
        for mark, time, area in points:
            axes.plot([time], [area], "o", color=mark.color(theme), markersize=7, markeredgecolor=theme.paper)
        names = [Name(short(mark).label, time, area, bold=mark.place == 0) for mark, time, area in points]
        place_labels(axes, names, [(time, area) for _, time, area in points])

    said = [f"{mark.label} {number(area)} at {milliseconds(time)} ms" for mark, time, area in points]
    return render("cost", f"AUC-PR over milliseconds per query: {enumerate_words(said)}.", sheet, paint)


def plot_scalability(points: Sequence[ScalePoint], cast: Cast) -> list[Plot]:
    """Accuracy and matching time as the references grow (thesis, Figure 3.9)."""
    systems = list(dict.fromkeys(point.system for point in points))
    of_system = {
        system: sorted((point for point in points if point.system == system), key=lambda point: point.references)
        for system in systems
    }
    asked: list[tuple[str, str, str, Callable[[ScalePoint], float | None]]] = [
        ("scalability-auc-pr", "Accuracy as the map grows", "AUC-PR", lambda point: point.auc_pr),
        ("scalability-recall", "Recall@1 as the map grows", "recall@1", lambda point: point.recall_at_1),
        ("scalability-time", "Matching time as the map grows", "milliseconds", lambda point: point.milliseconds),
    ]
    plots = []
    for name, title, what, value in asked:
        lines = [
            Line(cast.named(system), [float(x) for x, _ in known], [y for _, y in known])
            for system, some in of_system.items()
            if (known := [(point.references, y) for point in some if (y := value(point)) is not None])
        ]
        if lines:
            plots.append(
                _trend(name, title, "references", what, lines, logarithmic=True, is_time=what == "milliseconds")
            )
    return plots


def plot_severity(curves: Sequence[SeverityCurve], cast: Cast) -> list[Plot]:
    """AUC-PR and recall@1 as each disturbance grows, in the order of the disturbances.

    Two plots, for AUC-PR alone would mislead: of a few right matches it can rise as all else falls.
    """
    disturbances = list(dict.fromkeys(curve.disturbance for curve in curves))
    stems = file_stems(disturbances)
    plots = []
    for disturbance, stem in zip(disturbances, stems, strict=True):
        some = [curve for curve in curves if curve.disturbance == disturbance]
        name, unit = plain(disturbance), plain(some[0].unit)
        axis = f"{name}, {unit}" if unit else name
        title = name[:1].upper() + name[1:]
        lines = [Line(cast.named(curve.system), curve.levels, curve.auc_pr) for curve in some]
        plots.append(_trend(f"severity-{stem}", title, axis, "AUC-PR", lines))
        lines = [Line(cast.named(curve.system), curve.levels, curve.recall_at_1) for curve in some]
        plots.append(_trend(f"severity-{stem}-recall", f"{title}, recall@1", axis, "recall@1", lines))
    return plots


def _trend(
    name: str,
    title: str,
    x: str,
    y: str,
    lines: Sequence[Line],
    *,
    logarithmic: bool = False,
    is_time: bool = False,
) -> Plot:
    """Lines with a dot at each point, named at their ends.

    Args:
        logarithmic: x grows by factors.
        is_time: y is in milliseconds, and grows by factors too; otherwise it is a share.
    """
    sheet = Sheet(title, height=max(320, 15 * len(lines) + 90), margins=Margins(right=206))
    form = milliseconds if is_time else number

    def drawn(line: Line) -> Sequence[float]:
        return [max(value, SHORTEST) for value in line.y] if is_time else line.y

    def paint(axes: Axes, theme: Theme) -> None:
        axes.set(xlabel=x, ylabel=y)
        starts, ends = [line.x[0] for line in lines], [line.x[-1] for line in lines]
        if is_time:
            values = [value for line in lines for value in drawn(line)]
            axes.set_yscale("log")
            axes.set_ylim(min(values) / 1.4, max(values) * 1.4)
            plain_log_ticks(axes.yaxis)
        else:
            shares(axes, x=False, y=True)
        if logarithmic:
            axes.set_xscale("log")
            axes.set_xlim(min(starts) / 1.03, max(max(ends), min(starts) * 1.5))
            plain_log_ticks(axes.xaxis)
        else:
            span = (max(ends) - min(starts)) or 1.0
            axes.set_xlim(min(starts) - 0.02 * span, max(max(ends), min(starts) + span))
        for line in sorted(lines, key=lambda line: -line.mark.place):
            axes.plot(
                line.x,
                drawn(line),
                color=line.mark.color(theme),
                linestyle=line.mark.linestyle,
                linewidth=line.mark.width,
                marker="o",
                markersize=3.2,
                clip_on=False,
            )
        label_ends(axes, theme, sheet, [EndLabel(line.mark, drawn(line)[-1], form(line.y[-1])) for line in lines])

    said = [
        f"{line.mark.label} from {form(line.y[0])} at {line.x[0]:g} to {form(line.y[-1])} at {line.x[-1]:g}"
        for line in lines
    ]
    return render(name, f"{title}: {y} over {x}. {enumerate_words(said)}.", sheet, paint)
