"""The figures of all systems: the columns of the table that can be sorted by each of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab.evaluation import DEPTHS, STAGES
from lab.evaluation.report.text import MISSING, milliseconds, number, size
from lab.evaluation.report.trends import time_per_query

if TYPE_CHECKING:
    from lab.evaluation.protocol.comparison import SystemRun


DOUBTS = {"ours": "decision", "score": "score", "ratio": "ratio", "spread": "spread"}
"""Headings of the measures of doubt, and their fields in :class:`lab.evaluation.protocol.trust.Doubt`."""


@dataclass(frozen=True)
class Column:
    """One figure: its heading, its meaning, how to find and write it, and which end of it is good."""

    group: str
    heading: str
    meaning: str
    value: Callable[[SystemRun], float | None]
    form: Callable[[float | None], str] = number
    higher_is_better: bool = True
    contest: bool = True
    """Its best figure stands out."""
    bar: bool = False
    """Its size, of 1, is drawn behind it."""

    def best(self, runs: Sequence[SystemRun]) -> float | None:
        """The figure that stands out; None where there is no contest."""
        values = [value for run in runs if (value := self.value(run)) is not None]
        if len(runs) < 2 or not values or not self.contest:
            return None
        return max(values) if self.higher_is_better else min(values)


def columns(runs: Sequence[SystemRun]) -> list[Column]:
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
        *(_doubt_column(heading, name) for heading, name in DOUBTS.items()),
        Column("Milliseconds per query", "total", "all stages", time_per_query, milliseconds, higher_is_better=False),
        *(_stage_column(stage) for stage in stages(runs)),
        Column("Memory", "a place", "bytes per place", lambda run: run.bytes_per_place, _size, higher_is_better=False),
    ]
    return [column for column in made if any(column.value(run) is not None for run in runs)]


def stages(runs: Sequence[SystemRun]) -> list[str]:
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


def _doubt_column(heading: str, name: str) -> Column:
    def area(run: SystemRun) -> float | None:
        return None if run.evaluation.trust is None else float(getattr(run.evaluation.trust.doubt, name))

    return Column("Doubt", heading, f"is the best match right? area under precision and recall by the {name}", area)


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
    return MISSING if value is None else size(int(value))
