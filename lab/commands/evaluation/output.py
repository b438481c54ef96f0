"""``placerec evaluate``: its tables, JSON and CSV files, and remarks."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lab.evaluation import DEPTHS, Evaluation, Outcome, SystemComparison, SystemRun
from lab.evaluation.data.published import RECALLS, PublishedRecall
from lab.evaluation.protocol.results import results_csv
from service.commands.console import number, remark, show, table, write_file
from service.commands.encoders.models import name_of

if TYPE_CHECKING:
    from lab.evaluation.cache import EvaluationCache
    from lab.evaluation.run import Extras

RULES = {"mean_of_negatives": "mean of true negatives", "full_precision": "best wrong match"}

_option = partial(typer.Option, rich_help_panel="Output")


@dataclass(frozen=True)
class OutputOptions:
    """The measurements beside the accuracy, and the files to write."""

    json_file: Annotated[Path | None, _option("--json", metavar="OUT.json", help="Write the figures.")] = None
    results: Annotated[
        Path | None,
        _option(metavar="OUT.csv", help="Write one row per query; further encoders go to OUT.ENCODER.csv."),
    ] = None
    report: Annotated[Path | None, _option(metavar="DIR", help="Write an HTML page with curves and images.")] = None
    scalability: Annotated[
        bool, _option("--scalability", help="Also measure traverses of growing length (thesis, Fig. 3.9).")
    ] = False
    severity: Annotated[bool, _option("--severity", help="Also measure queries that are disturbed in steps.")] = False
    cache: Annotated[
        Path | None,
        _option(
            metavar="DIR",
            help="Directory of the cache. Default: placerec/evaluations in the user's cache directory.",
        ),
    ] = None
    no_cache: Annotated[bool, _option("--no-cache", help="Measure everything again and keep nothing.")] = False

    def check(self) -> None:
        """Check that the options go together.

        Raises:
            typer.BadParameter: they do not.
        """
        if self.no_cache and self.cache is not None:
            raise typer.BadParameter("give --cache or --no-cache, not both")

    def open_cache(self) -> EvaluationCache:
        """The cache that the options ask for."""
        from lab.evaluation.cache import EvaluationCache, default_folder

        return EvaluationCache(None if self.no_cache else self.cache or default_folder())

    def extras(self, seed: int) -> Extras:
        """The measurements beside the accuracy; ``seed`` draws the disturbances."""
        from lab.evaluation.run import Extras

        return Extras(self.scalability, self.severity, seed, map_sizes=self.report is not None)

    def write(self, comparison: SystemComparison, runs: Sequence[SystemRun], elsewhere: Sequence[SystemRun]) -> None:
        """Write the files that the options name.

        Args:
            runs: of the systems, in the order of the command line.
            elsewhere: of systems that others have computed.
        """
        if self.json_file is not None:
            write_json(self.json_file, comparison_json(comparison, [*runs, *elsewhere]))
        if self.results is not None:
            write_results(self.results, [(run.identity, run.outcomes) for run in runs])
        if self.report is not None:
            from lab.evaluation.report import write_report

            write_report(self.report, comparison)
            remark(f"The report is written: {self.report / 'index.html'}")


def show_figures(figures: Sequence[Evaluation], title: str, verified: Sequence[str | None] | None = None) -> None:
    """A row of accuracy for each encoder; matches of one class only get a word in place of AUC-PR.

    Args:
        verified: when each verified its matches, as of :func:`verify_of`; None: it is known of none.
    """
    columns = ("#AUC-PR", "#AUC-ROC", *(f"#recall@{depth}" for depth in DEPTHS), "#recall at full precision")
    names = ("encoder",) if verified is None else ("encoder", "verified")
    shown = table(*names, *columns, "#extended precision", "#right", title=title)
    for row, when in zip(figures, verified or [None] * len(figures), strict=True):
        values = [row.auc_roc, *(row.recall_at[str(depth)] for depth in DEPTHS)]
        shown.add_row(
            name_of(row.encoder),
            *([] if verified is None else [when or "–"]),
            row.one_class or number(row.auc_pr),
            *map(number, values),
            number(row.recall_at_full_precision),
            number(row.extended_precision),
            f"{row.right} of {row.queries}",
        )
    show(shown)


def verify_of(run: SystemRun) -> str | None:
    """When a system verified the geometry of its matches: auto, always or never; None if others have computed it."""
    return None if run.elsewhere else str(run.about.configuration.get("verification.verify", "never"))


def show_costs(figures: Sequence[Evaluation]) -> None:
    """A row of times and memory for each encoder; medians per query."""
    stages = list(dict.fromkeys(stage for row in figures for stage in row.milliseconds if stage != "match"))
    shown = table("encoder", *(f"#{stage} ms" for stage in stages), "#described ms", "#match ms", "#KB a place")
    for row in figures:
        place = None if row.bytes_per_place is None else row.bytes_per_place / 1000
        shown.add_row(
            name_of(row.encoder),
            *(number(row.milliseconds.get(stage), 2) for stage in stages),
            number(row.describe_milliseconds, 2),
            number(row.milliseconds["match"], 3),
            number(place, 1),
        )
    show(shown)


def show_thresholds(figures: Sequence[Evaluation]) -> None:
    """A table of what thresholds do to right and wrong answers; nothing without a true negative."""
    counts = ("true_positives", "false_positives", "false_negatives", "true_negatives")
    heads = ("TP", "FP", "FN", "TN")
    shown = table("encoder", "threshold", "#at", *(f"#{head}" for head in heads), title="Thresholds, before → after")
    for row in figures:
        for one in row.thresholds if row.negatives else []:
            before, after = one.before.model_dump(), one.after.model_dump()
            changes = [f"{before[name]} → {after[name]}" for name in counts]
            shown.add_row(name_of(row.encoder), RULES[one.rule], number(one.threshold), *changes)
    if shown.row_count:
        show(shown)


def remark_notes(figures: Sequence[Evaluation], notes: Iterable[str], cached: Sequence[str]) -> None:
    """Remarks: why figures are missing, special properties of the data, and which figures are cached."""
    for note in notes:
        remark(note)
    reasons = dict.fromkeys((name, reason) for row in figures for name, reason in row.notes.items())
    named: dict[str, list[str]] = {}
    for name, reason in reasons:
        named.setdefault(reason, []).append(name)
    for reason, names in named.items():
        remark(f"{', '.join(names)}: {reason}")
    if cached:
        remark(f"Taken from the cache, times included: {', '.join(cached)}.")


def show_published(published: Sequence[PublishedRecall]) -> None:
    """A table of what others have published of the protocol; nothing where nobody has."""
    heads = (f"#recall@{depth}" for depth in RECALLS)
    title = "Published by others of this protocol; not measured here"
    shown = table("system", *heads, "#year", "source", title=title)
    for one in published:
        recalls = [*one.recall_at, *(None for _ in RECALLS[len(one.recall_at) :])]
        shown.add_row(one.system, *map(number, recalls), str(one.year), one.source)
    if shown.row_count:
        show(shown)


def show_trends(comparison: SystemComparison) -> None:
    """Tables of growing traverses and of disturbed queries, where they were measured."""
    if comparison.scalability:
        shown = table(
            "encoder", "#references", "#queries", "#AUC-PR", "#recall@1", "#match ms", title="Growing traverses"
        )
        for point in comparison.scalability:
            counts = (str(point.references), str(point.queries))
            figures = (number(point.auc_pr), number(point.recall_at_1), number(point.milliseconds, 3))
            shown.add_row(point.system, *counts, *figures)
        show(shown)
    if comparison.severity:
        steps = [f"step {step}" for step in range(1, max(len(curve.levels) for curve in comparison.severity))]
        columns = ("encoder", "disturbance", "undisturbed", *steps, "unit of the levels")
        shown = table(*columns, title="Disturbed queries, level: AUC-PR and recall@1")
        for curve in comparison.severity:
            levels = zip(curve.levels, curve.auc_pr, curve.recall_at_1, strict=True)
            cells = [f"{level:g}: {area:.3f} {recall:.3f}" for level, area, recall in levels]
            shown.add_row(curve.system, curve.disturbance, *cells, curve.unit)
        show(shown)


def run_json(run: SystemRun) -> dict[str, Any]:
    """The figures of a run and its system."""
    about = {"title": run.about.title, "paper": run.about.paper, "configuration": dict(run.about.configuration)}
    marks = {"verify": verify_of(run), "cached": run.cached, **({"elsewhere": True} if run.elsewhere else {})}
    return {**run.evaluation.model_dump(), **about, **marks}


def comparison_json(comparison: SystemComparison, runs: Sequence[SystemRun]) -> dict[str, Any]:
    """The first run's figures on the top level, those of all in ``encoders``, and what else was measured.

    Args:
        runs: in the order of the command line.
    """
    every = [run_json(run) for run in runs]
    trends: dict[str, Any] = {}
    if comparison.scalability is not None:
        trends["scalability"] = [asdict(point) for point in comparison.scalability]
    if comparison.map_sizes is not None:
        trends["map_sizes"] = [asdict(point) for point in comparison.map_sizes]
    if comparison.severity is not None:
        trends["severity"] = [asdict(curve) for curve in comparison.severity]
    if comparison.published:
        trends["published"] = [asdict(one) for one in comparison.published]
    if comparison.notes:
        trends["remarks"] = comparison.notes
    return {**every[0], "encoders": every, **trends}


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write figures whole or not at all."""
    write_file(path, json.dumps(value, indent=2) + "\n")


def write_results(path: Path, outcomes: Sequence[tuple[str, Sequence[Outcome]]]) -> None:
    """A CSV file for each encoder: the first at ``path``, the others beside it with their names."""
    for index, (name, rows) in enumerate(outcomes):
        further = path.with_suffix(f".{name_of(name)}{path.suffix}")
        write_file(path if index == 0 else further, results_csv(rows))
