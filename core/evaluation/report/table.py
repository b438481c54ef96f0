"""The figures of all systems as a table that can be sorted by each of its columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from core.evaluation import DEPTHS, STAGES
from core.evaluation.report.text import escape, milliseconds, number, size
from core.evaluation.report.theme import Cast, Mark
from core.evaluation.report.trends import time_per_query

if TYPE_CHECKING:
    from core.evaluation.protocol.comparison import Run


@dataclass(frozen=True)
class Column:
    """One figure: its heading, what it means, how to find and write it, and which end of it is good."""

    group: str
    heading: str
    meaning: str
    value: Callable[[Run], float | None]
    form: Callable[[float | None], str] = number
    higher_is_better: bool = True
    contest: bool = True
    """Its best figure stands out."""
    bar: bool = False
    """Its size, of 1, is drawn behind it."""


def columns(runs: Sequence[Run]) -> list[Column]:
    """The columns that at least one run has a figure for."""
    made = [
        Column(
            "Accuracy", "AUC-PR", "area under the precision–recall curve", lambda run: run.evaluation.auc_pr, bar=True
        ),
        Column("Accuracy", "AUC-ROC", "area under the ROC curve", lambda run: run.evaluation.auc_roc),
        *(_recall_column(depth) for depth in DEPTHS),
        Column(
            "Accuracy",
            "R@100 %P",
            "recall at 100 % precision: right matches that outscore every wrong one",
            lambda run: run.evaluation.recall_at_full_precision,
        ),
        Column("Accuracy", "EP", "extended precision", lambda run: run.evaluation.extended_precision),
        Column("Milliseconds per query", "total", "all stages", time_per_query, milliseconds, higher_is_better=False),
        *(_stage_column(stage) for stage in stages(runs)),
        Column("Memory", "a place", "bytes per place", lambda run: run.bytes_per_place, _size, higher_is_better=False),
    ]
    return [column for column in made if any(column.value(run) is not None for run in runs)]


def stages(runs: Sequence[Run]) -> list[str]:
    """The stages that some run has a time for: the usual ones in their order, others after them, ``match`` last."""
    timed = {stage: None for run in runs for stage, time in run.milliseconds.items() if time is not None}
    usual = [stage for stage in STAGES if stage in timed and stage != "match"]
    others = [stage for stage in timed if stage not in STAGES]
    return usual + others + (["match"] if "match" in timed else [])


def _recall_column(depth: int) -> Column:
    return Column(
        "Accuracy",
        f"R@{depth}",
        f"recall@{depth}: queries with a true reference among the best {depth}",
        lambda run: run.evaluation.recall_at.get(str(depth)),
    )


def _stage_column(stage: str) -> Column:
    return Column(
        "Milliseconds per query",
        stage,
        f"the stage {stage}",
        lambda run: run.milliseconds.get(stage),
        milliseconds,
        higher_is_better=False,
        contest=False,
    )


def _size(value: float | None) -> str:
    return size(int(value or 0))


def figures_table(runs: Sequence[Run], cast: Cast) -> str:
    """The table as HTML; the best figure of each column stands out where there are several systems."""
    shown = columns(runs)
    groups = dict.fromkeys(column.group for column in shown)
    spans = "".join(
        f'<th scope="colgroup" colspan="{sum(column.group == group for column in shown)}">{group}</th>'
        for group in groups
    )
    heads = "".join(_head(column, first=index == 0) for index, column in enumerate(shown))
    best = [_best(column, runs) for column in shown]
    rows = "".join(_row(run, mark, shown, best) for run, mark in zip(runs, cast.runs, strict=True))
    return (
        '<div class="wide" tabindex="0" role="region" aria-label="Table of all figures">'
        '<table class="figures sortable">'
        f'<thead><tr class="groups"><td></td>{spans}</tr>'
        f'<tr><th scope="col"><button type="button">System</button></th>{heads}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _head(column: Column, *, first: bool) -> str:
    sort = ' aria-sort="descending"' if first else ""
    rising = "" if column.higher_is_better else ' data-first="ascending"'
    return (
        f'<th scope="col"{sort}{rising} title="{escape(column.meaning)}">'
        f'<button type="button">{escape(column.heading)}</button></th>'
    )


def _best(column: Column, runs: Sequence[Run]) -> float | None:
    values = [value for run in runs if (value := column.value(run)) is not None]
    if len(runs) < 2 or not values or not column.contest:
        return None
    return max(values) if column.higher_is_better else min(values)


def _row(run: Run, mark: Mark, shown: Sequence[Column], best: Sequence[float | None]) -> str:
    cells = "".join(_cell(run, column, top) for column, top in zip(shown, best, strict=True))
    name = f'<a href="#run-{mark.place}">{swatch(mark)}{escape(mark.label)}</a>'
    return f'<tr><th scope="row" data-value="{escape(mark.label.lower())}">{name}</th>{cells}</tr>'


def _cell(run: Run, column: Column, best: float | None) -> str:
    value = column.value(run)
    if value is None:
        return f'<td class="none">{column.form(None)}</td>'
    text = escape(column.form(value))
    word = run.evaluation.one_class if column.heading == "AUC-PR" else None
    if word is not None:
        text += f' <span class="word">{escape(word)}</span>'
    classes = [name for name, holds in (("best", value == best), ("bar", column.bar)) if holds]
    named = f' class="{" ".join(classes)}"' if classes else ""
    filled = f' style="--size:{100 * value:.1f}%"' if column.bar else ""
    return f'<td data-value="{float(value)!r}"{named}{filled}>{text}</td>'


def swatch(mark: Mark) -> str:
    """A short line in the system's colour and style."""
    dashes = " ".join(f"{2 * length:g}" for length in mark.dashes)
    style = f' stroke-dasharray="{dashes}"' if dashes else ""
    return (
        f'<svg class="swatch" viewBox="0 0 22 8" aria-hidden="true"><line x1="1" x2="21" y1="4" y2="4" '
        f'class="hue-{mark.hue}"{style}/></svg>'
    )
