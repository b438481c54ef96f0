"""``placerec evaluate``: figures of results and similarities that other tools have saved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from core.errors import InvalidGroundTruth
from core.frames.traverses import read_retained_references
from lab.commands.evaluation.output import remark_notes, show_figures, show_thresholds, write_json, write_results
from lab.commands.evaluation.truth import TruthOptions
from lab.evaluation import Evaluation, Outcome, judge, summarize
from lab.evaluation.protocol.results import read_results, summarize_results
from service.commands.console import Failure

_option = partial(typer.Option, rich_help_panel="Results that other tools have saved")


@dataclass(frozen=True)
class SavedOptions:
    """Files of results, or files of similarities."""

    from_results: Annotated[
        list[Path] | None,
        _option(
            metavar="FILE.csv", help="Rows query,retrieved,score,matched, with or without a header; may be repeated."
        ),
    ] = None
    from_similarity: Annotated[
        list[Path] | None,
        _option(
            metavar="FILE.npy",
            help="A matrix with a row per query and a column per reference; needs --ground-truth or --tolerance; "
            "may be repeated.",
        ),
    ] = None
    transposed: Annotated[bool, _option("--transposed", help="The matrix has a row per reference instead.")] = False

    def given(self) -> bool:
        """Whether there are any files."""
        return bool(self.from_results or self.from_similarity)

    def check(self, truth: TruthOptions, limit: Path | None, output: Path | None, others: Mapping[str, object]) -> None:
        """Check that no option is given that needs images or systems.

        Args:
            limit: lists the retained references.
            output: where rows would be written.
            others: the options that need images or systems, by name, with their values.

        Raises:
            typer.BadParameter: one is.
        """
        if self.from_results and self.from_similarity:
            raise typer.BadParameter("give --from-results or --from-similarity, not both")
        needless = {**others, "poses": truth.poses}
        if self.from_results:
            needless |= {"ground-truth": truth.given(), "results": output, "limit-references": limit}
            needless["transposed"] = self.transposed
        given = [f"--{name}" for name, value in needless.items() if value]
        if given:
            source = "--from-results" if self.from_results else "--from-similarity"
            raise typer.BadParameter(f"{source} cannot go with {', '.join(given)}: there are only saved figures")
        if self.from_similarity:
            if (truth.ground_truth is None) == (truth.tolerance is None):
                raise typer.BadParameter("--from-similarity goes with --ground-truth or --tolerance, one of them")
            truth.check()
            if output is not None and len({path.stem for path in self.from_similarity}) < len(self.from_similarity):
                raise typer.BadParameter("--results needs files of different names: it names its own after them")

    def show(self, truth: TruthOptions, limit: Path | None, json_file: Path | None, output: Path | None) -> None:
        """Write the table and the files that the options name.

        Args:
            limit: lists the retained references of matrices.
            json_file: where figures are written.
            output: where rows are written.
        """
        if self.from_results:
            figures = [summarize_results(path.name, read_results(path)) for path in self.from_results]
            _show(figures, "Saved results", json_file)
            return
        paths = self.from_similarity or []
        judged = [self._judge(path, truth, limit) for path in paths]
        _show([figures for figures, _ in judged], "Saved similarities", json_file)
        if output is not None:
            outcomes = [outcomes for _, outcomes in judged]
            write_results(output, list(zip([path.stem for path in paths], outcomes, strict=True)))

    def _judge(self, path: Path, truth: TruthOptions, limit: Path | None) -> tuple[Evaluation, list[Outcome]]:
        import numpy as np

        from lab.evaluation.protocol.results import read_similarity

        scores = read_similarity(path, self.transposed)
        queries, references = scores.shape
        retained = (
            np.arange(references, dtype=np.int64) if limit is None else read_retained_references(limit, references)
        )
        try:
            true = truth.of_counts(queries, references)
        except InvalidGroundTruth as error:
            raise Failure(
                f"{error} {path.name} was read as {queries} queries by {references} references; --transposed turns it."
            ) from error
        outcomes = judge(scores[:, retained], retained, true)
        return summarize(path.name, outcomes, len(retained), {}), outcomes


def _show(figures: Sequence[Evaluation], title: str, json_file: Path | None) -> None:
    show_figures(figures, title)
    show_thresholds(figures)
    remark_notes(figures, [], [])
    if json_file is not None:
        every = [row.model_dump() for row in figures]
        write_json(json_file, {**every[0], "encoders": every})
