"""``placerec evaluate``: how well systems recognize one traverse by another, in the figures of the thesis."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.markup import escape
from rich.progress import Progress, TaskID

from lab.commands.evaluation.output import (
    comparison_json,
    remark_notes,
    show_costs,
    show_figures,
    show_published,
    show_thresholds,
    show_trends,
    verify_of,
    write_json,
    write_results,
)
from lab.commands.evaluation.saved_results import SavedOptions
from lab.commands.evaluation.systems import build_systems, parse_weights, show_list
from lab.commands.evaluation.traverses import TraverseOptions, TruthOptions, choose_training
from lab.evaluation import Comparison
from service.commands.console import progress, remark
from service.commands.encoders.models import ModelsDir, load_image, open_catalogue
from service.commands.recordings import (
    PANEL,
    EveryChange,
    EveryDegrees,
    EveryMetres,
    EverySeconds,
    LargestGap,
    PoseTopic,
    RecordingOptions,
    Topic,
    TrajectoryFile,
    TrajectoryTimes,
)

if TYPE_CHECKING:
    from lab.evaluation.cache import EvaluationCache

TRAVERSES, TRUTH, SYSTEMS, OUTPUT, FILES = (
    "Traverses",
    "Ground truth (one of three ways, unless --dataset brings its own)",
    "Systems",
    "Output",
    "Results that other tools have saved",
)


def evaluate(
    reference: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="The known traverse: a directory of images, a bag or a video.",
            rich_help_panel=TRAVERSES,
        ),
    ] = None,
    query: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="The traverse to recognize: a directory of images, a bag or a video.",
            rich_help_panel=TRAVERSES,
        ),
    ] = None,
    dataset: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="A data set under a protocol by its name instead; see --list.",
            rich_help_panel=TRAVERSES,
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="The directory that holds the data set's traverses, or any directory of its published tree.",
            rich_help_panel=TRAVERSES,
        ),
    ] = None,
    others: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="With --dataset: also judge the similarities that others have computed, NAME.npy for each system, "
            "queries by references; they are marked as computed elsewhere.",
            rich_help_panel=SYSTEMS,
        ),
    ] = None,
    reduced: Annotated[
        bool,
        typer.Option("--reduced", help="Keep only as many references as the thesis.", rich_help_panel=TRAVERSES),
    ] = False,
    limit_references: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Keep only the references whose indices this file lists, one per line.",
            rich_help_panel=TRAVERSES,
        ),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            help="Seed of the reduced references, of training and of the disturbances.",
            rich_help_panel=TRAVERSES,
        ),
    ] = 0,
    tolerance: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=0, help="Query i shows the same place as references i-N to i+N.", rich_help_panel=TRUTH
        ),
    ] = None,
    ground_truth: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="Rows query,reference: the true references of each query, indices from 0.",
            rich_help_panel=TRUTH,
        ),
    ] = None,
    poses: Annotated[
        bool,
        typer.Option(
            "--poses",
            help="By the poses in places.csv of both directories (as for enroll), in file names "
            "(@easting@northing@…) or in EXIF data.",
            rich_help_panel=TRUTH,
        ),
    ] = False,
    metres: Annotated[
        float | None,
        typer.Option(
            metavar="N", min=0, help="With --poses: true if at most so many metres apart.", rich_help_panel=TRUTH
        ),
    ] = None,
    degrees: Annotated[
        float | None,
        typer.Option(
            metavar="N",
            min=0,
            max=180,
            help="With --poses: and if headings differ by at most so many degrees.",
            rich_help_panel=TRUTH,
        ),
    ] = None,
    encoder: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Encoder (name or identity) or system (name); may be repeated. Default: the service's encoder.",
            rich_help_panel=SYSTEMS,
        ),
    ] = None,
    verify: Annotated[
        Literal["auto", "always", "never"],
        typer.Option(
            help="When the geometry of the best matches is verified, as of a query to the service: where the scores "
            "leave doubt, always, or never. It holds for encoders of two stages whose name says nothing of stages.",
            rich_help_panel=SYSTEMS,
        ),
    ] = "auto",
    every: Annotated[
        bool,
        typer.Option(
            "--all", help="All systems that need no weights file, or whose file is given.", rich_help_panel=SYSTEMS
        ),
    ] = False,
    weights: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FILE", help="The weights file of a system; may be repeated.", rich_help_panel=SYSTEMS
        ),
    ] = None,
    training: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Images (subdirectories included) for systems that learn. Default: the kept references.",
            rich_help_panel=SYSTEMS,
        ),
    ] = None,
    models_dir: ModelsDir = None,
    listed: Annotated[
        bool, typer.Option("--list", help="List systems and data sets, and do nothing else.", rich_help_panel=SYSTEMS)
    ] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="OUT.json", help="Write the figures.", rich_help_panel=OUTPUT)
    ] = None,
    results: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.csv",
            help="Write one row per query; further encoders go to OUT.ENCODER.csv.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write an HTML page with curves and images.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    scalability: Annotated[
        bool,
        typer.Option(
            "--scalability", help="Also measure traverses of growing length (thesis, Fig. 3.9).", rich_help_panel=OUTPUT
        ),
    ] = False,
    severity: Annotated[
        bool,
        typer.Option("--severity", help="Also measure queries that are disturbed in steps.", rich_help_panel=OUTPUT),
    ] = False,
    cache: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Directory of the cache. Default: placerec/evaluations in the user's cache directory.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    no_cache: Annotated[
        bool, typer.Option("--no-cache", help="Measure everything again and keep nothing.", rich_help_panel=OUTPUT)
    ] = False,
    from_results: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE.csv",
            help="Rows query,retrieved,score,matched, with or without a header; may be repeated.",
            rich_help_panel=FILES,
        ),
    ] = None,
    from_similarity: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE.npy",
            help="A matrix with a row per query and a column per reference; needs --ground-truth or --tolerance; "
            "may be repeated.",
            rich_help_panel=FILES,
        ),
    ] = None,
    transposed: Annotated[
        bool,
        typer.Option("--transposed", help="The matrix has a row per reference instead.", rich_help_panel=FILES),
    ] = False,
    topic: Topic = None,
    query_topic: Annotated[
        str | None, typer.Option(help="The same of the traverse to recognize.", rich_help_panel=PANEL)
    ] = None,
    pose_topic: PoseTopic = None,
    query_pose_topic: Annotated[
        str | None, typer.Option(help="The same of the traverse to recognize.", rich_help_panel=PANEL)
    ] = None,
    trajectory: TrajectoryFile = None,
    query_trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The same of the traverse to recognize.", rich_help_panel=PANEL),
    ] = None,
    trajectory_times: TrajectoryTimes = None,
    query_trajectory_times: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The same of the traverse to recognize.", rich_help_panel=PANEL),
    ] = None,
    largest_gap: LargestGap = None,
    every_metres: EveryMetres = None,
    every_degrees: EveryDegrees = None,
    every_seconds: EverySeconds = None,
    every_change: EveryChange = None,
) -> None:
    """Evaluate place recognition on two traverses of the same places.

    The default is what the service answers: the default encoder with three stages,
    the last where the first two leave doubt (--verify). NAME.first-stage and
    NAME.two-stages judge fewer.

    Images of a directory (not of its subfolders) are taken in natural order; one
    that cannot be decoded stops the run. A query without a kept true reference is
    a true negative. Results are cached: a second run measures only what is new and
    repeats the times of the first. Of bags and videos, indices are those of the
    frames that are taken: in the order of their times, keyframes only where the
    --every options ask for them.
    """
    truth = TruthOptions(tolerance, ground_truth, poses, metres, degrees)
    if listed:
        show_list(open_catalogue(models_dir))
        return
    if from_results or from_similarity:
        saved = SavedOptions(from_results or [], from_similarity or [], transposed, truth, limit_references)
        needs_images = {"reference": reference, "query": query, "dataset": dataset, "data": data, "reduced": reduced}
        needs_systems = {"encoder": encoder, "all": every, "weights": weights, "training": training}
        needs_both = {"others": others, "report": report, "scalability": scalability, "severity": severity}
        saved.check({**needs_images, **needs_systems, **needs_both}, results)
        saved.show(json_file, results)
        return
    if transposed:
        raise typer.BadParameter("--transposed goes with --from-similarity")
    if no_cache and cache is not None:
        raise typer.BadParameter("give --cache or --no-cache, not both")
    ways = (largest_gap, every_metres, every_degrees, every_seconds, every_change)
    taken = RecordingOptions(topic, pose_topic, trajectory, trajectory_times, *ways)
    asked = RecordingOptions(query_topic, query_pose_topic, query_trajectory, query_trajectory_times, *ways)
    options = TraverseOptions(reference, query, truth, dataset, data, reduced, limit_references, seed, taken, asked)
    options.check()
    if others is not None and dataset is None:
        raise typer.BadParameter("--others goes with --dataset: the matrices belong to its queries and references")
    files = parse_weights(weights or [])

    # Imported here because they take a second.
    from lab.evaluation.cache import EvaluationCache, default_folder
    from lab.evaluation.elsewhere import read_others
    from lab.evaluation.run import Extras, compare_systems

    with ExitStack() as stack:
        pair = options.open(stack, encoder[0] if encoder else None)
        elsewhere = [] if others is None else read_others(others, pair)
        lessons = choose_training(training, pair, seed)
        systems = build_systems(encoder or [], every, files, open_catalogue(models_dir), verify)
        kept = EvaluationCache(None if no_cache else cache or default_folder())
        with progress() as bar:
            extras = Extras(scalability, severity, seed, map_sizes=report is not None)
            comparison = compare_systems(systems, pair, lessons, load_image, kept, _Bar(bar), extras, elsewhere)
        _show(comparison, kept)
        by_name = {run.about.name: run for run in comparison.runs if not run.elsewhere}
        runs = [by_name[system.about.name] for system in systems]  # in the order of the command line
        if json_file is not None:
            write_json(json_file, comparison_json(comparison, [*runs, *elsewhere]))
        if results is not None:
            write_results(results, [(run.identity, run.outcomes) for run in runs])
        if report is not None:
            from lab.evaluation.report import write_report

            write_report(report, comparison)
            remark(f"The report is written: {report / 'index.html'}")


class _Bar:
    """Shows the progress of the evaluation as a bar."""

    def __init__(self, bar: Progress) -> None:
        self._bar = bar
        self._task = TaskID(0)
        self._steps = 0

    def begin(self, system: str, steps: int) -> None:
        self._steps = steps
        self._task = self._bar.add_task(escape(system), total=steps)

    def advance(self) -> None:
        self._bar.advance(self._task)

    def end(self) -> None:
        self._bar.update(self._task, completed=self._steps)


def _show(comparison: Comparison, cache: EvaluationCache) -> None:
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
        remark(f"Nothing was kept for a next run: {cache.folder} cannot be written; choose another with --cache.")
