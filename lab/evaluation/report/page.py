"""The page of a comparison: its sources, and the files beside it; ``page.html`` says how it reads."""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from core.errors import StorageFailure, StorageFull
from lab.evaluation.data.published import RECALLS
from lab.evaluation.report.charts import Chart
from lab.evaluation.report.closeup import closeup
from lab.evaluation.report.curves import plot_pr, plot_recall, plot_reliability, plot_roc, trusted
from lab.evaluation.report.matrix import RIGHT, TRUTH, WRONG
from lab.evaluation.report.table import columns
from lab.evaluation.report.text import counted, enumerate_words, file_stems, number, plain
from lab.evaluation.report.theme import DARK, LIGHT, Cast, variables
from lab.evaluation.report.thumbnails import Thumbnails
from lab.evaluation.report.trends import plot_cost, plot_map_sizes, plot_scalability, plot_severity

if TYPE_CHECKING:
    from lab.evaluation.protocol.comparison import SystemComparison


def write_report(folder: Path, comparison: SystemComparison) -> None:
    """Write ``index.html``, which needs no other file and no network, and its charts as PNG files beside it.

    The same comparison gives the same bytes.  Nothing is written before all is made; files of an
    earlier report are replaced, those that this one has not stay.

    Raises:
        ValueError: the comparison has no run.
        StorageFull: the disk is full.
        StorageFailure: the folder cannot be written to.
    """
    if not comparison.runs:
        raise ValueError("a report needs at least one run")
    runs, cast = comparison.runs, Cast(comparison.runs)
    accuracy = [plot_pr(runs, cast), plot_roc(runs, cast), plot_recall(runs, cast), plot_cost(runs, cast)]
    drawn: dict[str, Sequence[Chart | None]] = {
        "accuracy": accuracy,
        "reliability": [plot_reliability(runs, cast)],
        "sizes": plot_map_sizes(comparison.map_sizes or [], cast),
        "scalability": plot_scalability(comparison.scalability or [], cast),
        "severity": plot_severity(comparison.severity or [], cast),
    }
    charts = {section: [chart for chart in some if chart is not None] for section, some in drawn.items()}
    thumbnails = Thumbnails()
    stems = file_stems([run.about.name for run in runs])
    closeups = [
        closeup(comparison, run, mark, stem, thumbnails) for run, mark, stem in zip(runs, cast.runs, stems, strict=True)
    ]
    shown = columns(runs)
    html = page(
        comparison=comparison,
        runs=runs,
        marks=cast.runs,
        charts=charts,
        remarks=_remarks(comparison, cast),
        columns=shown,
        groups=list(Counter(column.group for column in shown).items()),
        recalls=RECALLS,
        elsewhere=[mark.label for run, mark in zip(runs, cast.runs, strict=True) if run.elsewhere],
        cached=[mark.label for run, mark in zip(runs, cast.runs, strict=True) if run.cached],
        trusted=trusted(runs, cast),
        closeups=closeups,
        pictures=thumbnails.retained,
    )
    every = [chart for some in [*charts.values(), *(one.fates for one in closeups)] for chart in some]
    files = {f"{chart.name}.png": chart.png for chart in every}
    files |= {f"similarity-{one.stem}.png": one.similarity for one in closeups}
    write_files(folder, {**files, "index.html": html.encode("utf-8")})


def page(**values: Any) -> str:
    """The page of these values, each of which is escaped where it stands."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: plain(value) if type(value) is str else value,  # markup is of another type
    )
    environment.filters |= {"number": number, "counted": counted, "enumerate_words": enumerate_words}
    keys = {"truth": TRUTH, "right": RIGHT, "wrong": WRONG}
    return environment.get_template("page.html").render(values, light=variables(LIGHT), dark=variables(DARK), keys=keys)


def _remarks(comparison: SystemComparison, cast: Cast) -> list[str]:
    """Why curves are missing."""
    runs = comparison.runs
    without = [
        mark.label for run, mark in zip(runs, cast.runs, strict=True) if run.evaluation.one_class == "none right"
    ]
    remarks = []
    if without:
        remarks.append(f"No best match is right, so there is no precision–recall curve, of {enumerate_words(without)}.")
    notes = dict.fromkeys(run.evaluation.notes.get("auc_roc", "") for run in runs)
    return remarks + [f"There is no ROC curve: {note}" for note in notes if note]


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
