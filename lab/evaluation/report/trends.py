"""Accuracy against what varies: time per query, number of references, strength of a disturbance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab.evaluation.report.charts import FIRST, HEIGHT, Chart, draw, plain_log_ticks, plot_line, shares
from lab.evaluation.report.curves import height_for
from lab.evaluation.report.text import enumerate_words, file_stems, milliseconds, number, plain
from lab.evaluation.report.theme import LIGHT, Cast, Mark, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from lab.evaluation.protocol.comparison import ScalePoint, SeverityCurve, SizePoint, SystemRun


SHORTEST = 1e-3
"""Milliseconds: shorter times are drawn as this, for an axis by factors has no zero."""

SHAPES = ("o", "s", "^", "D")
"""Of the points of systems that share a hue."""


@dataclass(frozen=True)
class Line:
    """One system's points, by rising x."""

    mark: Mark
    x: Sequence[float]
    y: Sequence[float]


def time_per_query(run: SystemRun) -> float | None:
    """Milliseconds of all stages of one query, the image's decoding left out; None where none was measured."""
    stages = {stage: time for stage, time in run.milliseconds.items() if time is not None}
    describing = run.evaluation.describe_milliseconds
    if describing is not None:
        return describing + stages.get("match", 0.0)
    return sum(stages.values()) if stages else None


def plot_cost(runs: Sequence[SystemRun], cast: Cast) -> Chart | None:
    """Accuracy over the time of a query; None unless two systems have both."""
    points = [
        (mark, time, run.evaluation.auc_pr)
        for run, mark in zip(runs, cast.runs, strict=True)
        if (time := time_per_query(run)) is not None and time > 0
    ]
    if len(points) < 2:
        return None

    def paint(axes: Axes) -> None:
        areas = [area for _, _, area in points]
        air = 0.12 * (max(areas) - min(areas)) or 0.1
        axes.set_ylim(max(0, min(areas) - air), min(1.015, max(areas) + air))
        axes.set(xlabel="milliseconds per query, all stages", ylabel="AUC-PR", xscale="log")
        axes.margins(x=0.12)
        for mark, time, area in points:
            label = f"{number(area)}  {short(mark).label}"
            shape = SHAPES[mark.place // len(LIGHT.hues) % len(SHAPES)]
            gid = FIRST if mark.place == 0 else None
            axes.plot([time], [area], shape, label=label, color=mark.color(LIGHT), markersize=7, gid=gid)
        plain_log_ticks(axes.xaxis)

    said = [f"{mark.label} {number(area)} at {milliseconds(time)} ms" for mark, time, area in points]
    alt = f"AUC-PR over milliseconds per query: {enumerate_words(said)}."
    return draw("cost", alt, "Accuracy and time", paint, height_for(points, HEIGHT))


def plot_scalability(points: Sequence[ScalePoint], cast: Cast) -> list[Chart]:
    """Accuracy and matching time as the references grow (thesis, Figure 3.9)."""
    systems = list(dict.fromkeys(point.system for point in points))
    of_system = {
        system: sorted((point for point in points if point.system == system), key=lambda point: point.references)
        for system in systems
    }
    charts: list[tuple[str, str, str, Callable[[ScalePoint], float | None]]] = [
        ("scalability-auc-pr", "Accuracy as the map grows", "AUC-PR", lambda point: point.auc_pr),
        ("scalability-recall", "Recall@1 as the map grows", "recall@1", lambda point: point.recall_at_1),
        ("scalability-time", "Matching time as the map grows", "milliseconds", lambda point: point.milliseconds),
    ]
    plots = []
    for name, title, what, value in charts:
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


def plot_map_sizes(points: Sequence[SizePoint], cast: Cast) -> list[Chart]:
    """The verdicts of the shipped calibrations, and the error of their probabilities, by size of map."""
    charts: list[tuple[str, str, str, Callable[[SizePoint], float | None]]] = [
        ("sizes-error", "Probabilities by size of map", "calibration error", lambda point: point.calibration_error),
        ("sizes-known", "Known places by size of map", "recognized, right", lambda point: point.known_recognized),
        ("sizes-strangers", "Strangers by size of map", "recognized", lambda point: point.strangers_recognized),
        ("verified-error", "Probabilities, verified", "calibration error", lambda point: point.verified_error),
        ("verified-known", "Known places, verified", "recognized, right", lambda point: point.verified_known),
        ("verified-strangers", "Strangers, verified", "recognized", lambda point: point.verified_strangers),
    ]
    plots = []
    for name, title, what, value in charts:
        found: dict[str, list[tuple[float, float]]] = {}
        for point in points:
            if (y := value(point)) is not None:
                found.setdefault(point.system, []).append((float(point.places), y))
        lines = [Line(cast.named(system), [x for x, _ in some], [y for _, y in some]) for system, some in found.items()]
        if lines:
            plots.append(_trend(name, title, "places", what, lines, logarithmic=True))
    return plots


def plot_severity(curves: Sequence[SeverityCurve], cast: Cast) -> list[Chart]:
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
) -> Chart:
    """Lines with a dot at each point, named at their ends.

    Args:
        logarithmic: x grows by factors.
        is_time: y is in milliseconds, and grows by factors too; otherwise it is a share.
    """
    form = milliseconds if is_time else number

    def drawn(line: Line) -> Sequence[float]:
        return [max(value, SHORTEST) for value in line.y] if is_time else line.y

    def paint(axes: Axes) -> None:
        axes.set(xlabel=x, ylabel=y)
        starts, ends = [line.x[0] for line in lines], [line.x[-1] for line in lines]
        if is_time:
            values = [value for line in lines for value in drawn(line)]
            axes.set(yscale="log", ylim=(min(values) / 1.4, max(values) * 1.4))
            plain_log_ticks(axes.yaxis)
        else:
            shares(axes, x=False, y=True)
        if logarithmic:
            axes.set(xscale="log", xlim=(min(starts) / 1.03, max(max(ends), min(starts) * 1.5)))
            plain_log_ticks(axes.xaxis)
        else:
            span = (max(ends) - min(starts)) or 1.0
            axes.set_xlim(min(starts) - 0.02 * span, max(max(ends), min(starts) + span))
        for line in sorted(lines, key=lambda line: -line.y[-1]):  # the legend in the order of the ends
            label = form(line.y[-1])
            plot_line(axes, line.mark, line.x, drawn(line), label, marker="o", markersize=3.2, clip_on=False)

    said = [
        f"{line.mark.label} from {form(line.y[0])} at {line.x[0]:g} to {form(line.y[-1])} at {line.x[-1]:g}"
        for line in lines
    ]
    alt = f"{title}: {y} over {x}. {enumerate_words(said)}."
    return draw(name, alt, title, paint, height_for(lines, 320))
