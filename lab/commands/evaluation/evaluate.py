"""``placerec evaluate``: how well systems recognize one traverse by another, in the figures of the thesis."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

import typer
from rich.progress import Progress, TaskID

from lab.commands.evaluation.output import (
    OutputOptions,
    remark_notes,
    show_costs,
    show_figures,
    show_published,
    show_thresholds,
    show_trends,
    verify_of,
)
from lab.commands.evaluation.saved_results import SavedOptions
from lab.commands.evaluation.systems import SystemOptions, show_list
from lab.commands.evaluation.traverses import RecordingsOptions, TraverseOptions, choose_training
from lab.commands.evaluation.truth import TruthOptions
from lab.evaluation import SystemComparison
from service.commands.console import progress, remark
from service.commands.encoders.models import load_image, open_catalogue
from service.commands.options.objects import takes

if TYPE_CHECKING:
    from lab.evaluation.cache import EvaluationCache


@dataclass(frozen=True)
class EvaluateOptions:
    """The options of the command, by the panels of its help."""

    traverses: TraverseOptions
    truth: TruthOptions
    systems: SystemOptions
    output: OutputOptions
    saved: SavedOptions
    recordings: RecordingsOptions

    def check(self) -> None:
        """Check that the options of a comparison go together.

        Raises:
            typer.BadParameter: they do not.
        """
        if self.saved.transposed:
            raise typer.BadParameter("--transposed goes with --from-similarity")
        self.output.check()
        self.traverses.check(self.truth)
        self.systems.weights_files()

    def of_images_or_systems(self) -> dict[str, object]:
        """The options that need images or systems, by name, with their values."""
        traverses, systems, output = self.traverses, self.systems, self.output
        return {
            "reference": traverses.reference,
            "query": traverses.query,
            "dataset": traverses.dataset,
            "data": traverses.data,
            "reduced": traverses.reduced,
            "encoder": systems.encoder,
            "all": systems.every,
            "weights": systems.weights,
            "training": systems.training,
            "others": traverses.others,
            "report": output.report,
            "scalability": output.scalability,
            "severity": output.severity,
        }


@takes(EvaluateOptions)
def evaluate(options: EvaluateOptions) -> None:
    """Evaluate place recognition on two traverses of the same places.

    The default is what the service answers: the default encoder with three stages,
    the last where the first two leave doubt (--verify). NAME.first-stage and
    NAME.two-stages judge fewer.

    Images of a directory (not of its subfolders) are taken in natural order; one
    that cannot be decoded stops the run. A query without a retained true reference is
    a true negative. Results are cached: a second run measures only what is new and
    repeats the times of the first. Of bags and videos, indices are those of the
    frames that are taken: in the order of their times, keyframes only where the
    --every options ask for them.
    """
    if options.systems.listed:
        show_list(open_catalogue(options.systems.models_dir))
    elif options.saved.given():
        _show_saved(options)
    else:
        options.check()
        _compare(options)


def _show_saved(options: EvaluateOptions) -> None:
    saved, truth, output, limit = options.saved, options.truth, options.output, options.traverses.limit_references
    saved.check(truth, limit, output.results, options.of_images_or_systems())
    saved.show(truth, limit, output.json_file, output.results)


def _compare(options: EvaluateOptions) -> None:
    # Imported here because they take a second.
    from lab.evaluation.elsewhere import read_others
    from lab.evaluation.run import compare_systems

    traverses, systems_options, output = options.traverses, options.systems, options.output
    with ExitStack() as stack:
        pair = traverses.open(options.truth, options.recordings, stack, systems_options.keyframe_encoder)
        elsewhere = [] if traverses.others is None else read_others(traverses.others, pair)
        lessons = choose_training(systems_options.training, pair, traverses.seed)
        systems = systems_options.build()
        cache = output.open_cache()
        with progress() as bar:
            extras = output.extras(traverses.seed)
            comparison = compare_systems(systems, pair, lessons, load_image, cache, _Bar(bar), extras, elsewhere)
        _show(comparison, cache)
        by_name = {run.about.name: run for run in comparison.runs if not run.elsewhere}
        output.write(comparison, [by_name[system.about.name] for system in systems], elsewhere)


class _Bar:
    """Shows the progress of the evaluation as a bar."""

    def __init__(self, bar: Progress) -> None:
        self._bar = bar
        self._task = TaskID(0)
        self._steps = 0

    def begin(self, system: str, steps: int) -> None:
        self._steps = steps
        self._task = self._bar.add_task(system, total=steps)

    def advance(self) -> None:
        self._bar.advance(self._task)

    def end(self) -> None:
        self._bar.update(self._task, completed=self._steps)


def _show(comparison: SystemComparison, cache: EvaluationCache) -> None:
    figures = [run.evaluation for run in comparison.runs]
    first = figures[0]
    title = f"{comparison.name}: {first.queries} queries against {first.references} references"
    show_figures(figures, title, [verify_of(run) for run in comparison.runs])
    show_costs([run.evaluation for run in comparison.runs if not run.elsewhere])
    show_thresholds(figures)
    show_trends(comparison)
    show_published(comparison.published)
    remark_notes(figures, comparison.notes, [run.about.name for run in comparison.runs if run.cached])
    if not cache.writable:
        remark(f"Nothing was cached for a next run: {cache.folder} cannot be written; choose another with --cache.")
