"""``placerec evaluate``: figures of results and similarities that other tools have saved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import typer

from core.errors import InvalidGroundTruth
from core.frames.traverses import Truth, read_kept_references
from lab.commands.evaluation.output import remark_notes, show_figures, show_thresholds, write_json, write_results
from lab.commands.evaluation.traverses import TruthOptions
from lab.evaluation import Evaluation, Outcome, judge, summarize
from lab.evaluation.protocol.results import read_results, summarize_results
from service.commands.console import Failure


@dataclass(frozen=True)
class SavedOptions:
    """Files of results, or files of similarities and what is true of them."""

    results: list[Path]
    similarities: list[Path]
    transposed: bool
    truth: TruthOptions
    limit_references: Path | None

    def check(self, others: Mapping[str, object], output: Path | None) -> None:
        """Check that no option is given that needs images or systems.

        Args:
            others: the options that need them, by name, with their values.
            output: where rows would be written.

        Raises:
            typer.BadParameter: one is.
        """
        if self.results and self.similarities:
            raise typer.BadParameter("give --from-results or --from-similarity, not both")
        asked = [f"--{name}" for name, value in others.items() if value]
        if self.truth.poses:
            asked.append("--poses")
        if self.results:
            more = {"ground-truth": self.truth.given(), "results": output, "limit-references": self.limit_references}
            asked += [f"--{name}" for name, value in more.items() if value]
            if self.transposed:
                asked.append("--transposed")
        if asked:
            source = "--from-results" if self.results else "--from-similarity"
            raise typer.BadParameter(f"{source} cannot go with {', '.join(asked)}: there are only saved figures")
        if self.similarities:
            if (self.truth.ground_truth is None) == (self.truth.tolerance is None):
                raise typer.BadParameter("--from-similarity goes with --ground-truth or --tolerance, one of them")
            self.truth.check()
            if output is not None and len(set(self._names())) < len(self.similarities):
                raise typer.BadParameter("--results needs files of different names: it names its own after them")

    def show(self, json_file: Path | None, results: Path | None) -> None:
        """Write the table and the files that the options name."""
        if self.results:
            figures = [summarize_results(path.name, read_results(path)) for path in self.results]
            _show(figures, "Saved results", json_file)
            return
        judged = [self._judge(path) for path in self.similarities]
        _show([figures for figures, _ in judged], "Saved similarities", json_file)
        if results is not None:
            write_results(results, list(zip(self._names(), [outcomes for _, outcomes in judged], strict=True)))

    def _names(self) -> list[str]:
        """The names under which the rows of each matrix are written."""
        return [path.stem for path in self.similarities]

    def _judge(self, path: Path) -> tuple[Evaluation, list[Outcome]]:
        import numpy as np

        from lab.evaluation.protocol.results import read_similarity

        scores = read_similarity(path, self.transposed)
        queries, references = scores.shape
        kept = np.arange(references, dtype=np.int64)
        if self.limit_references is not None:
            kept = read_kept_references(self.limit_references, references)
        outcomes = judge(scores[:, kept], kept, self._truth(path, queries, references))
        return summarize(path.name, outcomes, len(kept), {}), outcomes

    def _truth(self, path: Path, queries: int, references: int) -> Truth:
        try:
            return self.truth.of_counts(queries, references)
        except InvalidGroundTruth as error:
            raise Failure(
                f"{error} {path.name} was read as {queries} queries by {references} references; --transposed turns it."
            ) from error


def _show(figures: Sequence[Evaluation], title: str, json_file: Path | None) -> None:
    show_figures(figures, title)
    show_thresholds(figures)
    remark_notes(figures, [], [])
    if json_file is not None:
        every = [row.model_dump() for row in figures]
        write_json(json_file, {**every[0], "encoders": every})
