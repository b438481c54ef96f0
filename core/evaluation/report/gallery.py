"""Matches to look at: query, best match and true reference side by side, the wrong ones first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from core.evaluation.report.text import escape, number
from core.evaluation.report.thumbnails import Thumbnails, show

if TYPE_CHECKING:
    from core.baselines.encoders import Box
    from core.evaluation import Outcome
    from core.evaluation.protocol.comparison import Comparison, Run

Regions = Callable[[Path], "Sequence[Box] | None"]

MOST_BOXES = 24
"""Regions drawn on an image: more would hide it."""


@dataclass(frozen=True)
class Case:
    """One query of the gallery.

    truth: index of the true reference shown beside it; None where the query has none.
    truth_score: of that reference; None where it was not kept.
    """

    query: int
    outcome: Outcome
    truth: int | None
    truth_score: float | None


def wrong_first(outcomes: Sequence[Outcome], wrong: int, right: int) -> list[int]:
    """The queries to show: the most confident wrong matches, then right ones from sure to unsure.

    Args:
        wrong, right: how many of each at most.
    """
    falling = sorted(range(len(outcomes)), key=lambda query: (-outcomes[query].score, query))
    errors = [query for query in falling if not outcomes[query].matched]
    hits = [query for query in falling if outcomes[query].matched]
    spaced = np.linspace(0, len(hits) - 1, min(right, len(hits))).round().astype(int).tolist()
    return errors[:wrong] + [hits[place] for place in dict.fromkeys(spaced)]


def case(comparison: Comparison, run: Run, query: int) -> Case:
    """What to show of a query.

    Of a wrong match the best true reference, the one that was nearly chosen; of a right one the
    middle of the true ones, to see how far aside the match lies.
    """
    outcome, true, kept = run.outcomes[query], comparison.truth[query], comparison.kept
    if len(true) == 0:
        return Case(query, outcome, None, None)
    columns = np.flatnonzero(np.isin(kept, true))
    shown = int(true[len(true) // 2])
    if not outcome.matched and len(columns):
        shown = int(kept[columns[np.argmax(run.scores[query, columns])]])
    column = int(np.searchsorted(kept, shown))
    is_kept = column < len(kept) and int(kept[column]) == shown
    return Case(query, outcome, shown, float(run.scores[query, column]) if is_kept else None)


def gallery(comparison: Comparison, run: Run, thumbnails: Thumbnails, regions: Regions | None, most: int) -> str:
    """Up to ``most`` wrong matches and half as many right ones, as HTML; fewer when ``thumbnails`` is full."""
    chosen = wrong_first(run.outcomes, most, max(1, most // 2))
    total = len(run.outcomes)
    hits = sum(outcome.matched for outcome in run.outcomes)
    parts: dict[bool, list[str]] = {False: [], True: []}
    for query in chosen:
        if not thumbnails.full:
            found = case(comparison, run, query)
            parts[found.outcome.matched].append(_article(comparison, found, thumbnails, regions))
    drawn = any('class="regions"' in part for part in parts[False] + parts[True])
    return "".join(
        [
            _switch(drawn),
            _group("Wrong matches", "the most confident first", "wrong", parts[False], total - hits),
            _group("Right matches", "from the most to the least confident", "right", parts[True], hits),
        ]
    )


def _switch(drawn: bool) -> str:
    if not drawn:
        return ""
    return '<label class="switch regions-switch"><input type="checkbox" checked> regions of interest</label>'


def _group(title: str, order: str, kind: str, articles: Sequence[str], total: int) -> str:
    if total == 0:
        return f'<h4>{title}</h4><p class="quiet">There is none.</p>'
    if not articles:
        return f'<h4>{title}</h4><p class="quiet">All {total} are left out, to keep the page small.</p>'
    count = f"all {total}" if len(articles) == total else f"{len(articles)} of {total}"
    return (
        f'<h4>{title} <span class="quiet">{count}, {order}</span></h4>'
        f'<div class="cases {kind}">{"".join(articles)}</div>'
    )


def _article(comparison: Comparison, found: Case, thumbnails: Thumbnails, regions: Regions | None) -> str:
    """Three images and what they are."""
    outcome = found.outcome
    verdict = "right" if outcome.matched else "wrong"
    references, score = comparison.references, f"score {number(outcome.score)}"
    word = f'<span class="verdict">{verdict}</span>'
    panels = [
        _panel(Panel("Query", found.query), comparison.queries, thumbnails, regions),
        _panel(Panel("Best match", outcome.retrieved, score, word, "found"), references, thumbnails, regions),
    ]
    if found.truth is None:
        panels.append('<figure><div class="absent">none</div><figcaption><b>True reference</b></figcaption></figure>')
    else:
        panels.append(_panel(Panel("Truth", found.truth, _standing(found)), references, thumbnails, regions))
    return f'<article class="case {verdict}">{"".join(panels)}</article>'


def _standing(found: Case) -> str:
    """How near the true reference came."""
    if found.truth_score is None:
        return "left out of the references"
    if found.outcome.matched or found.outcome.rank is None:
        return f"score {number(found.truth_score)}"
    return f"score {number(found.truth_score)}, rank {found.outcome.rank}"


@dataclass(frozen=True)
class Panel:
    """One of the three images of a case: what it is, its number, what is said of it."""

    what: str
    index: int
    remark: str = ""
    verdict: str = ""
    style: str = ""


def _panel(panel: Panel, paths: Sequence[Path], thumbnails: Thumbnails, regions: Regions | None) -> str:
    """One image and its caption; where there is no image, the caption alone."""
    path = paths[panel.index] if panel.index < len(paths) else None
    thumbnail = None if path is None else thumbnails.add(path)
    if path is None or thumbnail is None:
        shown = '<div class="absent">no image</div>'
    else:
        boxes = list(dict.fromkeys((regions(path) or ()) if regions else ()))[:MOST_BOXES]
        shown = show(thumbnail, f"{panel.what}: image {panel.index}, {path.name}", boxes)
    remark = f'<span class="score">{escape(panel.remark)}</span>' if panel.remark else ""
    name = "" if path is None else f'<span class="file">{escape(path.name)}</span>'
    return (
        f'<figure class="{panel.style}">{shown}<figcaption><b>{panel.what}</b> {panel.index} '
        f"{panel.verdict}{remark}{name}</figcaption></figure>"
    )
