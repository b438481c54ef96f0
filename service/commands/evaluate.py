"""``placerec evaluate``: one traverse recognized by another, in the figures of the thesis."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.markup import escape

from core.evaluation import DEPTHS, STAGES, Describer, Evaluation, Outcome, results_csv
from core.evaluation import evaluate as run
from core.traverses import Truth, find_images, read_ground_truth, read_kept_references, tolerance_truth
from service.commands.console import number, progress, show, table, write_file
from service.commands.models import ModelsDir, default_encoder, load_image, name_of, open_catalogue


def evaluate(
    reference: Annotated[Path, typer.Option(metavar="DIR", help="The traverse that is known.", show_default=False)],
    query: Annotated[Path, typer.Option(metavar="DIR", help="The traverse to recognize.", show_default=False)],
    tolerance: Annotated[
        int | None, typer.Option(min=0, help="Query i is true at the references i-N to i+N.", show_default=False)
    ] = None,
    ground_truth: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Rows query,reference instead; indices from 0.")
    ] = None,
    encoder: Annotated[
        list[str] | None, typer.Option(help="Encoder by name or identity; may be repeated.", show_default=False)
    ] = None,
    limit_references: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep only the references whose indices stand here, one a line.")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="OUT.json", help="Write the figures.")] = None,
    results: Annotated[
        Path | None,
        typer.Option(metavar="OUT.csv", help="Write a row per query; of further encoders to OUT.ENCODER.csv."),
    ] = None,
    models_dir: ModelsDir = None,
) -> None:
    """Evaluate encoders on two traverses of the same places.

    Images of a directory (not of its subfolders) are taken in natural order; one that cannot be decoded stops the
    run. A query without a kept true reference is a true negative.
    """
    if (tolerance is None) == (ground_truth is None):
        raise typer.BadParameter("give either --tolerance or --ground-truth")
    references, queries = find_images(reference), find_images(query)
    truth = _truth(len(queries), len(references), tolerance, ground_truth)
    kept = np.arange(len(references), dtype=np.int64)
    if limit_references is not None:
        kept = read_kept_references(limit_references, len(references))

    catalogue = open_catalogue(models_dir)
    identities = list(dict.fromkeys(catalogue.resolve(name) for name in encoder or [default_encoder()]))
    runs = [_run(catalogue.get(identity), references, queries, truth, kept) for identity in identities]

    _show([figures for figures, _ in runs])
    if json_file is not None:
        every = [figures.model_dump() for figures, _ in runs]
        write_file(json_file, json.dumps({**every[0], "encoders": every}, indent=2) + "\n")
    if results is not None:
        for index, (figures, outcomes) in enumerate(runs):
            further = f".{name_of(figures.encoder)}{results.suffix}"
            write_file(results if index == 0 else results.with_suffix(further), results_csv(outcomes))


def _truth(queries: int, references: int, tolerance: int | None, path: Path | None) -> Truth:
    if path is not None:
        return read_ground_truth(path, queries, references)
    return tolerance_truth(queries, references, tolerance or 0)


def _run(
    encoder: Describer, references: list[Path], queries: list[Path], truth: Truth, kept: NDArray[np.int64]
) -> tuple[Evaluation, list[Outcome]]:
    with progress() as bar:
        task = bar.add_task(escape(name_of(encoder.identity)), total=len(kept) + len(queries))
        return run(encoder, references, queries, truth, kept, load_image, lambda: bar.advance(task))


def _show(figures: list[Evaluation]) -> None:
    first = figures[0]
    shown = table(
        "encoder",
        *("#AUC-PR", "#AUC-ROC", *(f"#recall@{depth}" for depth in DEPTHS), "#recall at full precision"),
        *(f"#{stage} ms" for stage in STAGES),
        title=f"{first.queries} queries against {first.references} references",
    )
    for row in figures:
        values = [row.auc_pr, row.auc_roc, *(row.recall_at[str(depth)] for depth in DEPTHS)]
        times = [number(row.milliseconds[stage], 2) for stage in STAGES]
        shown.add_row(name_of(row.encoder), *map(number, values), number(row.recall_at_full_precision), *times)
    show(shown)
