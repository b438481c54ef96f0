"""Matches to look at: query, best match and true reference side by side, the wrong ones first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lab.evaluation.report.text import number
from lab.evaluation.report.thumbnails import Thumbnail, Thumbnails

if TYPE_CHECKING:
    from lab.baselines.encoders import Box
    from lab.evaluation import Outcome
    from lab.evaluation.protocol.comparison import SystemComparison, SystemRun

Regions = Callable[[Path], "Sequence[Box] | None"]

MOST_BOXES = 24
"""Regions drawn on an image: more would hide it."""


@dataclass(frozen=True)
class Case:
    """One query of the gallery.

    truth: index of the true reference shown beside it; None where the query has none.
    truth_score: of that reference; None where it was not retained.
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


def case(comparison: SystemComparison, run: SystemRun, query: int) -> Case:
    """The view of a query in the gallery.

    Of a wrong match the best true reference, the one that was nearly chosen; of a right one the
    middle of the true ones, to see how far aside the match lies.
    """
    outcome, true, retained = run.outcomes[query], comparison.truth[query], comparison.retained
    if len(true) == 0:
        return Case(query, outcome, None, None)
    columns = np.flatnonzero(np.isin(retained, true))
    shown = int(true[len(true) // 2])
    if not outcome.matched and len(columns):
        shown = int(retained[columns[np.argmax(run.scores[query, columns])]])
    column = int(np.searchsorted(retained, shown))
    is_retained = column < len(retained) and int(retained[column]) == shown
    return Case(query, outcome, shown, float(run.scores[query, column]) if is_retained else None)


@dataclass(frozen=True)
class Panel:
    """One of the three images of a case.

    what: it is.
    index: of the image; None where the query has no true reference.
    remark: the text about it.
    name: of its file; "" where there is none.
    picture: None where the file is gone or holds no image.
    boxes: regions of interest as x, y, width, height in pixels of the picture.
    """

    what: str
    index: int | None
    remark: str = ""
    name: str = ""
    picture: Thumbnail | None = None
    boxes: Sequence[Box] = ()


@dataclass(frozen=True)
class Group:
    """The wrong or the right matches of a run.

    total: how many there are.
    cases: query, best match and truth of those that are shown.
    """

    title: str
    order: str
    kind: str
    total: int
    cases: Sequence[Sequence[Panel]]


def gallery(
    comparison: SystemComparison, run: SystemRun, thumbnails: Thumbnails, regions: Regions | None, most: int
) -> tuple[Group, Group]:
    """Up to ``most`` wrong matches and half as many right ones; fewer when ``thumbnails`` is full."""
    parts: dict[bool, list[Sequence[Panel]]] = {False: [], True: []}
    for query in wrong_first(run.outcomes, most, max(1, most // 2)):
        if not thumbnails.full:
            found = case(comparison, run, query)
            parts[found.outcome.matched].append(_panels(comparison, found, thumbnails, regions))
    hits = sum(outcome.matched for outcome in run.outcomes)
    order = "from the most to the least confident"
    return (
        Group("Wrong matches", "the most confident first", "wrong", len(run.outcomes) - hits, parts[False]),
        Group("Right matches", order, "right", hits, parts[True]),
    )


def _panels(
    comparison: SystemComparison, found: Case, thumbnails: Thumbnails, regions: Regions | None
) -> tuple[Panel, Panel, Panel]:
    """Three images and what they are."""

    def panel(what: str, index: int, paths: Sequence[Path], remark: str = "") -> Panel:
        path = paths[index] if index < len(paths) else None
        picture = None if path is None else thumbnails.add(path)
        if path is None or picture is None:
            return Panel(what, index, remark, "" if path is None else path.name)
        boxes = list(dict.fromkeys((regions(path) or ()) if regions else ()))[:MOST_BOXES]
        width, height = picture.width, picture.height
        scaled = [
            (left * width, top * height, (right - left) * width, (bottom - top) * height)
            for left, top, right, bottom in boxes
        ]
        return Panel(what, index, remark, path.name, picture, scaled)

    score, references = f"score {number(found.outcome.score)}", comparison.references
    return (
        panel("Query", found.query, comparison.queries),
        panel("Best match", found.outcome.retrieved, references, score),
        Panel("True reference", None)
        if found.truth is None
        else panel("Truth", found.truth, references, _nearness(found)),
    )


def _nearness(found: Case) -> str:
    """How near the true reference came."""
    if found.truth_score is None:
        return "left out of the references"
    if found.outcome.matched or found.outcome.rank is None:
        return f"score {number(found.truth_score)}"
    return f"score {number(found.truth_score)}, rank {found.outcome.rank}"
