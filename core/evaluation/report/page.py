"""The page: what it says first, its sections in order, how it looks, and the files beside it."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from core.errors import StorageFailure, StorageFull
from core.evaluation.report.closeup import closeup, embed
from core.evaluation.report.curves import plot_pr, plot_recall, plot_roc
from core.evaluation.report.drawing import Plot
from core.evaluation.report.matrix import RIGHT, TRUTH, WRONG
from core.evaluation.report.reliability import plot_reliability, trust_table
from core.evaluation.report.table import figures_table, swatch
from core.evaluation.report.text import counted, enumerate_words, escape, file_stems, number
from core.evaluation.report.theme import DARK, LIGHT, Cast, Theme
from core.evaluation.report.thumbnails import Thumbnails
from core.evaluation.report.trends import plot_cost, plot_scalability, plot_severity

if TYPE_CHECKING:
    from core.evaluation.protocol.comparison import Comparison


@dataclass
class Report:
    """What the sections are made from, and what they leave to be written.

    files: made so far, by their names.
    """

    comparison: Comparison
    cast: Cast
    thumbnails: Thumbnails = field(default_factory=Thumbnails)
    files: dict[str, bytes] = field(default_factory=dict)

    def embed(self, plots: Sequence[Plot | None], remarks: Sequence[str] = ()) -> str:
        """Those plots that there are, side by side where there is room, then what must be said of them."""
        drawn = [plot for plot in plots if plot is not None]
        self.files |= {f"{plot.name}.png": plot.light for plot in drawn}
        said = "".join(f'<p class="quiet">{escape(remark)}</p>' for remark in remarks)
        beside = f"<div>{said}</div>" if said else ""
        return f'<div class="plots">{"".join(map(embed, drawn))}{beside}</div>'


def write_report(folder: Path, comparison: Comparison) -> None:
    """Write ``index.html``, which needs no other file and no network, and its plots as PNG files beside it.

    The same comparison gives the same bytes.  Nothing is written before all is made; files of an
    earlier report are replaced, those that this one has not stay.

    Raises:
        ValueError: the comparison has no run.
        StorageFull: the disk is full.
        StorageFailure: the folder cannot be written to.
    """
    if not comparison.runs:
        raise ValueError("a report needs at least one run")
    report = Report(comparison, Cast(comparison.runs))
    html = _document(report).encode("utf-8")
    write_files(folder, {**report.files, "index.html": html})


@dataclass(frozen=True)
class Section:
    """A part of the page; it is left out where ``build`` returns nothing."""

    id: str
    title: str
    build: Callable[[Report], str]


def _document(report: Report) -> str:
    built = [(section, html) for section in SECTIONS if (html := section.build(report))]
    contents = "".join(f'<a href="#{section.id}">{section.title}</a>' for section, _ in built)
    body = "".join(f'<section id="{section.id}"><h2>{section.title}</h2>{html}</section>' for section, html in built)
    title = f"{escape(report.comparison.name)}: place recognition compared"
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="generator" content="placerec">'
        f'<meta name="theme-color" media="(prefers-color-scheme: light)" content="{LIGHT.paper}">'
        f'<meta name="theme-color" media="(prefers-color-scheme: dark)" content="{DARK.paper}">'
        f'<title>{title}</title><link rel="icon" href="data:,"><style>{stylesheet()}</style></head>\n'
        f'<body><header>{_opening(report)}<nav class="contents" aria-label="Sections">{contents}</nav></header>\n'
        f"<main>{body}</main>\n{report.thumbnails.definitions()}<script>{script()}</script></body></html>\n"
    )


def _opening(report: Report) -> str:
    """The name of the data, what came out in a sentence, and how large it is."""
    comparison = report.comparison
    first = comparison.runs[0]
    facts = [
        ("systems" if len(comparison.runs) > 1 else "system", str(len(comparison.runs))),
        ("queries", str(len(first.outcomes))),
        ("references matched against", str(len(comparison.kept))),
    ]
    negatives = sum(outcome.rank is None for outcome in first.outcomes)
    if negatives:
        facts.append(("queries without a true reference", str(negatives)))
    listed = "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in facts)
    notes = "".join(f'<p class="quiet">{escape(note)}</p>' for note in comparison.notes)
    return (
        f'<p class="eyebrow">Place recognition compared</p><h1>{escape(comparison.name)}</h1>'
        f'<p class="lead">{_finding(report)}</p><dl class="facts">{listed}</dl>{notes}'
    )


def _finding(report: Report) -> str:
    """Who is first, and by how much."""
    runs, marks = report.comparison.runs, report.cast.runs
    first = runs[0]
    name = f"<strong>{escape(marks[0].label)}</strong>"
    right = sum(outcome.matched for outcome in first.outcomes)
    found = f"its best match is right for {right} of {counted(len(first.outcomes), 'query')}"
    if len(runs) == 1:
        return f"{name} reaches an AUC-PR of {number(first.evaluation.auc_pr)}; {found}."
    second = f"{escape(marks[1].label)} ({number(runs[1].evaluation.auc_pr)})"
    if runs[1].evaluation.auc_pr == first.evaluation.auc_pr:
        return (
            f"{name} and {escape(marks[1].label)} share the first place by AUC-PR, {number(first.evaluation.auc_pr)}."
        )
    return f"{name} is first with an AUC-PR of {number(first.evaluation.auc_pr)}, before {second}; {found}."


def _accuracy(report: Report) -> str:
    runs, cast = report.comparison.runs, report.cast
    remarks = []
    without = [
        mark.label for run, mark in zip(runs, cast.runs, strict=True) if run.evaluation.one_class == "none right"
    ]
    if without:
        remarks.append(f"No best match is right, so there is no precision–recall curve, of {enumerate_words(without)}.")
    notes = dict.fromkeys(run.evaluation.notes.get("auc_roc", "") for run in runs)
    remarks += [f"There is no ROC curve: {note}" for note in notes if note]
    plots = [plot_pr(runs, cast), plot_roc(runs, cast), plot_recall(runs, cast), plot_cost(runs, cast)]
    intro = (
        "<p>Every query is answered with its best match. The number before a name is the area under its curve or, "
        "for recall, where the curve ends.</p>"
    )
    return intro + report.embed(plots, remarks)


def _figures(report: Report) -> str:
    runs = report.comparison.runs
    cached = [mark.label for run, mark in zip(runs, report.cast.runs, strict=True) if run.cached]
    remark = ""
    if cached:
        remark = f'<p class="quiet">Taken from an earlier run, times included: {escape(enumerate_words(cached))}.</p>'
    intro = "<p>A heading sorts the table; a name leads to the system’s matrix, scores and matches.</p>"
    return intro + figures_table(runs, report.cast) + remark


def _reliability(report: Report) -> str:
    runs, cast = report.comparison.runs, report.cast
    plot = plot_reliability(runs, cast)
    if plot is None:
        return ""
    intro = (
        "<p>Each best match is given a probability of being right, by a curve fitted on other parts of the traverse. "
        "Where that is honest, the points lie on the diagonal. The bars are Wilson’s intervals (95 %) of the first "
        "system; the number before a name is its expected calibration error.</p>"
    )
    return intro + report.embed([plot]) + trust_table(runs, cast)


def _scalability(report: Report) -> str:
    points = report.comparison.scalability
    if not points:
        return ""
    intro = "<p>The first places of the traverses, then more of them: what happens to accuracy, and to matching.</p>"
    return intro + report.embed(plot_scalability(points, report.cast))


def _severity(report: Report) -> str:
    curves = report.comparison.severity
    if not curves:
        return ""
    intro = "<p>The queries are changed step by step, the references stay as they are.</p>"
    return intro + report.embed(plot_severity(curves, report.cast))


def _closeups(report: Report) -> str:
    comparison, marks = report.comparison, report.cast.runs
    stems = file_stems([run.about.name for run in comparison.runs])
    chips = "".join(f'<a href="#run-{mark.place}">{swatch(mark)}{escape(mark.label)}</a>' for mark in marks)
    nav = f'<nav class="chips" aria-label="Systems">{chips}</nav>' if len(marks) > 1 else ""
    parts = []
    for run, mark, stem in zip(comparison.runs, marks, stems, strict=True):
        made = closeup(comparison, run, mark, stem, report.thumbnails)
        report.files |= made.files
        parts.append(made.html)
    return nav + "".join(parts)


TERMS = {
    "AUC-PR": "Area under the precision–recall curve of the best matches, by the trapezoid rule. Recall counts right "
    "matches only, so read it with R@1.",
    "AUC-ROC": "The chance that a query with a true reference outscores one without.",
    "R@k": "Share of the queries with a true reference that have one among their k best matches.",
    "R@100 %P": "Share of the queries with a true reference whose right match outscores every wrong match.",
    "EP": "Extended precision: the mean of R@100 %P and of the precision at the lowest recall.",
    "ECE": "Expected calibration error: by how much probabilities and what came of them differ, on average.",
    "Brier": "Mean square of probability minus outcome; beside it that of always stating the share of right matches.",
    "P, R at 95 %": "Precision and recall of the answers whose probability is at least 0.95, with Wilson’s interval.",
    "TP, FP": "Accepted matches that are right, and wrong.",
    "TN, FN": "Rejected queries without a true reference, and with one. Before anything is rejected, TN are the "
    "queries without a true reference.",
}


def _terms(report: Report) -> str:
    rows = "".join(f"<dt>{term}</dt><dd>{meaning}</dd>" for term, meaning in TERMS.items())
    return f'<dl class="terms">{rows}</dl>'


SECTIONS: tuple[Section, ...] = (
    Section("accuracy", "Accuracy", _accuracy),
    Section("figures", "All figures", _figures),
    Section("reliability", "Does it know when it is right?", _reliability),
    Section("scalability", "As the map grows", _scalability),
    Section("severity", "As conditions worsen", _severity),
    Section("systems", "System by system", _closeups),
    Section("terms", "What the figures mean", _terms),
)
"""The page from top to bottom; a new part is one line here."""


# How the page looks, and what its one script does


def stylesheet() -> str:
    """The rules of the page, its colours taken from the themes of the plots."""
    dark = f"@media (prefers-color-scheme: dark) {{ :root {{ {_variables(DARK)} }} }}"
    keys = f":root {{ --truth: {TRUTH}; --match-right: {RIGHT}; --match-wrong: {WRONG}; }}"
    hues = "".join(f".hue-{index} {{ stroke: var(--hue-{index}); }}" for index in range(len(LIGHT.hues)))
    return f":root {{ color-scheme: light dark; {_variables(LIGHT)} }}{dark}{keys}{hues}{_read('page.css')}"


def script() -> str:
    """What sorts the table, and shows one system at a time; without it all are shown."""
    return _read("page.js")


def _read(name: str) -> str:
    return (Path(__file__).parent / name).read_text("utf-8")


def _variables(theme: Theme) -> str:
    names = ("paper", "ink", "muted", "rule", "tp", "fp", "tn", "fn")
    tint = f"--tint: color-mix(in srgb, {theme.hues[0]} 16%, transparent);"
    hues = (f"--hue-{index}: {color};" for index, color in enumerate(theme.hues))
    return " ".join([*(f"--{name}: {getattr(theme, name)};" for name in names), tint, *hues])


# Its files


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write all files under temporary names, then give them theirs, in their order.

    The folder is made where it is missing; files of other names in it stay.  The last file should
    be the one that refers to the others.

    Raises:
        StorageFull: the disk is full; no file was changed.
        StorageFailure: the folder cannot be made or written to; unless it fails while files are
            renamed, no file was changed.
    """
    written: dict[Path, Path] = {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            partial = folder / f".{name}.{os.getpid()}.tmp"
            written[partial] = folder / name
            partial.write_bytes(data)
        for partial, final in written.items():
            os.replace(partial, final)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise StorageFull(f"The disk is full: the report in {folder} was not written.") from error
        raise StorageFailure(f"The report cannot be written to {folder}: {error.strerror}.") from error
    finally:
        for partial in written:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
