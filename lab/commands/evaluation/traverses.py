"""``placerec evaluate``: the traverses, and the images to learn from."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from core.frames.traverses import find_images, find_images_below, read_retained_references
from lab.commands.evaluation.systems import SYSTEMS
from lab.commands.evaluation.truth import TruthOptions
from service.commands.console import progress
from service.commands.options.recordings import (
    PANEL,
    EveryChange,
    EveryDegrees,
    EveryMetres,
    EverySeconds,
    FixedFrame,
    LargestGap,
    MostSpeed,
    MovingFrame,
    PoseTopic,
    RecordingOptions,
    Topic,
    TrajectoryFile,
    TrajectoryTimes,
)

if TYPE_CHECKING:
    from lab.evaluation.data.pairs import TraversePair
    from lab.evaluation.subject import Training

_option = partial(typer.Option, rich_help_panel="Traverses")
_of_query = partial(typer.Option, help="The same of the traverse to recognize.", rich_help_panel=PANEL)


@dataclass(frozen=True)
class RecordingsOptions:
    """The options of two recordings: of the known traverse, of the one to recognize, and those that hold for both."""

    topic: Topic = None
    query_topic: Annotated[str | None, _of_query()] = None
    pose_topic: PoseTopic = None
    query_pose_topic: Annotated[str | None, _of_query()] = None
    fixed_frame: FixedFrame = None
    query_fixed_frame: Annotated[str | None, _of_query(metavar="FRAME")] = None
    moving_frame: MovingFrame = None
    query_moving_frame: Annotated[str | None, _of_query(metavar="FRAME")] = None
    trajectory: TrajectoryFile = None
    query_trajectory: Annotated[Path | None, _of_query(metavar="FILE")] = None
    trajectory_times: TrajectoryTimes = None
    query_trajectory_times: Annotated[Path | None, _of_query(metavar="FILE")] = None
    largest_gap: LargestGap = None
    most_speed: MostSpeed = None
    every_metres: EveryMetres = None
    every_degrees: EveryDegrees = None
    every_seconds: EverySeconds = None
    every_change: EveryChange = None

    @property
    def of_reference(self) -> RecordingOptions:
        """Those of the known traverse."""
        return RecordingOptions(
            self.topic,
            self.pose_topic,
            self.trajectory,
            self.trajectory_times,
            *self._of_both,
            self.fixed_frame,
            self.moving_frame,
            self.most_speed,
        )

    @property
    def of_query(self) -> RecordingOptions:
        """Those of the traverse to recognize."""
        return RecordingOptions(
            self.query_topic,
            self.query_pose_topic,
            self.query_trajectory,
            self.query_trajectory_times,
            *self._of_both,
            self.query_fixed_frame,
            self.query_moving_frame,
            self.most_speed,
        )

    @property
    def _of_both(self) -> tuple[float | None, float | None, float | None, float | None, float | None]:
        return self.largest_gap, self.every_metres, self.every_degrees, self.every_seconds, self.every_change


@dataclass(frozen=True)
class TraverseOptions:
    """Two recordings, or a data set in a directory, and what is taken of them."""

    reference: Annotated[
        Path | None, _option(metavar="DIR", help="The known traverse: a directory of images, a bag or a video.")
    ] = None
    query: Annotated[
        Path | None,
        _option(metavar="DIR", help="The traverse to recognize: a directory of images, a bag or a video."),
    ] = None
    dataset: Annotated[
        str | None,
        _option(metavar="NAME", help="A data set under a protocol by its name instead; see --list."),
    ] = None
    data: Annotated[
        Path | None,
        _option(
            metavar="DIR",
            help="The directory that holds the data set's traverses, or any directory of its published tree.",
        ),
    ] = None
    others: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="With --dataset: also judge the similarities that others have computed, NAME.npy for each system, "
            "queries by references; they are marked as computed elsewhere.",
            rich_help_panel=SYSTEMS,
        ),
    ] = None
    reduced: Annotated[bool, _option("--reduced", help="Keep only as many references as the thesis.")] = False
    limit_references: Annotated[
        Path | None,
        _option(metavar="FILE", help="Keep only the references whose indices this file lists, one per line."),
    ] = None
    seed: Annotated[
        int, _option(min=0, help="Seed of the reduced references, of training and of the disturbances.")
    ] = 0

    def check(self, truth: TruthOptions) -> None:
        """Check that the options go together, and with those of the ground truth.

        Raises:
            typer.BadParameter: they do not.
        """
        if self.dataset is None:
            if self.reference is None or self.query is None:
                raise typer.BadParameter("give --reference and --query, or --dataset with --data")
            if self.data is not None or self.reduced:
                raise typer.BadParameter("--data and --reduced go with --dataset")
            truth.check()
            if self.others is not None:
                raise typer.BadParameter(
                    "--others goes with --dataset: the matrices belong to its queries and references"
                )
        elif self.reference is not None or self.query is not None or truth.given():
            raise typer.BadParameter("--dataset brings its own traverses and truth: give only --data with it")
        elif self.data is None:
            raise typer.BadParameter("--dataset needs --data, the directory that holds its traverses")
        elif self.reduced and self.limit_references is not None:
            raise typer.BadParameter("--reduced and --limit-references both choose the references to keep: give one")

    def open(
        self, truth: TruthOptions, recordings: RecordingsOptions, stack: ExitStack, encoder: str | None
    ) -> TraversePair:
        """The traverses with their truth.

        Args:
            stack: closes the folders into which the frames of bags and videos are written.
            encoder: by which keyframes are chosen where ``--every-change`` is given; None for the default.

        Raises:
            InvalidTraverse, InvalidGroundTruth: something is missing or malformed.
        """
        from lab.evaluation.data.datasets import find_dataset, open_dataset
        from lab.evaluation.data.pairs import TraversePair, all_references, limit

        if self.dataset is not None:
            assert self.data is not None, "checked"
            pair = open_dataset(find_dataset(self.dataset), self.data, self.reduced, self.seed)
        else:
            assert self.reference is not None and self.query is not None, "checked"
            references = _images(self.reference, recordings.of_reference, stack, encoder)
            queries = _images(self.query, recordings.of_query, stack, encoder)
            true, retained = truth.of_images(queries, references), all_references(references)
            pair = TraversePair(name_pair(self.reference, self.query), references, queries, true, retained)
        if self.limit_references is None:
            return pair
        retained = read_retained_references(self.limit_references, len(pair.references))
        return limit(pair, retained)


def _images(path: Path, options: RecordingOptions, stack: ExitStack, encoder: str | None) -> list[Path]:
    """The images of a directory, or the frames of a recording, written into a folder that ``stack`` removes."""
    if path.is_dir() and options == RecordingOptions():
        from core.recordings.bag import bag_files

        if not bag_files(path):
            return find_images(path)
    from core.recordings.extraction import extract

    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="placerec-")))
    with options.open(path) as recording, progress() as bar:
        chosen = options.choose(recording, encoder)
        return extract(bar.track(chosen, description=f"Reading {path.name}"), folder)


def name_pair(reference: Path, query: Path) -> str:
    """The name of a pair: ``nordland, winter against summer`` if both lie in one folder, else without the folder."""
    known, queried = reference.resolve(), query.resolve()
    traverses = f"{queried.name} against {known.name}"
    same = known.parent == queried.parent and known.parent.name
    return f"{known.parent.name}, {traverses}" if same else traverses


def choose_training(directory: Path | None, pair: TraversePair, seed: int) -> Training:
    """The images to learn from: those of a directory, or else the retained references.

    Raises:
        InvalidTraverse: the directory holds no image.
    """
    from lab.evaluation.subject import Training

    if directory is None:
        return Training(pair.retained_references, "the retained references", seed)
    images = find_images_below(directory)
    return Training(images, f"{len(images)} images of {directory.resolve().name}", seed)
