"""The fate of the queries before and after a threshold on the score (thesis, section 3.4.3, Figure 3.17)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from lab.evaluation.report.charts import Chart, draw
from lab.evaluation.report.text import enumerate_words, number
from lab.evaluation.report.theme import LIGHT

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from lab.evaluation import Outcome

Fate = Literal["tp", "fp", "tn", "fn"]
FATES: tuple[Fate, ...] = get_args(Fate)
Scores = Mapping[Fate, NDArray[np.float64]]
"""The scores of each fate, falling."""


def fate(outcome: Outcome, threshold: float) -> Fate:
    """True or false, positive or negative, where matches that do not score above the threshold are rejected."""
    if outcome.score > threshold:
        return "tp" if outcome.matched else "fp"
    return "tn" if outcome.rank is None else "fn"


def fate_before(outcome: Outcome) -> Fate:
    """As the thesis draws it where nothing is rejected: queries without a true reference stand apart, as TN."""
    if outcome.rank is None:
        return "tn"
    return "tp" if outcome.matched else "fp"


def scores_by_fate(outcomes: Sequence[Outcome], threshold: float | None) -> Scores:
    """The scores of each fate, falling; before thresholding where ``threshold`` is None."""
    found: dict[Fate, list[float]] = {name: [] for name in FATES}
    for outcome in outcomes:
        found[fate_before(outcome) if threshold is None else fate(outcome, threshold)].append(outcome.score)
    return {name: np.sort(np.array(scores, np.float64))[::-1] for name, scores in found.items()}


def plot_fates(name: str, system: str, outcomes: Sequence[Outcome], threshold: float | None) -> list[Chart]:
    """The scores of each fate before and, where there is a threshold, after it, on the same axes."""
    states: list[tuple[str, str, float | None]] = [("before", "Before the threshold", None)]
    if threshold is not None:
        states.append(("after", "After the threshold", threshold))
    found = [scores_by_fate(outcomes, applied) for _, _, applied in states]
    longest = max(len(scores) for state in found for scores in state.values())
    scores = [outcome.score for outcome in outcomes]
    low, high = min(scores), max(scores)
    air = 0.07 * (high - low) or 0.07 * abs(high) or 0.07
    frame = PlotScales(longest, low - air, high + air, threshold)
    return [
        _plot(f"scores-{state}-{name}", title, system, shown, frame)
        for (state, title, _), shown in zip(states, found, strict=True)
    ]


@dataclass(frozen=True)
class PlotScales:
    """The scales that the two plots share: most queries of one fate, lowest and highest score shown, the threshold."""

    longest: int
    low: float
    high: float
    threshold: float | None


def _plot(name: str, title: str, system: str, found: Scores, frame: PlotScales) -> Chart:
    def paint(axes: Axes) -> None:
        from matplotlib.ticker import MaxNLocator

        axes.set(xlabel="queries, by falling score", ylabel="score of the best match")
        axes.set(xlim=(0, max(2, frame.longest) * 1.02), ylim=(frame.low, frame.high))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
        for fate, scores in found.items():
            if len(scores):
                shown = {"color": getattr(LIGHT, fate), "label": f"{fate.upper()} {len(scores)}"}
                size = 2.6 if frame.longest < 150 else 0
                axes.plot(range(1, len(scores) + 1), scores, linewidth=1.6, marker="o", markersize=size, **shown)
        if frame.threshold is not None:
            label = f"threshold {number(frame.threshold)}"
            axes.axhline(frame.threshold, color=LIGHT.ink, linewidth=0.9, linestyle=(0, (4, 3)), label=label)

    counts = [f"{len(scores)} {fate.upper()}" for fate, scores in found.items()]
    return draw(name, f"{title}, scores of {system}: {enumerate_words(counts)}.", title, paint, height=320)
