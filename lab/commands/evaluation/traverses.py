"""``placerec evaluate``: the traverses, their ground truth, and the images to learn from."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.markup import escape

from core.frames.traverses import (
    Truth,
    find_images,
    find_images_below,
    read_ground_truth,
    read_kept_references,
    tolerance_truth,
)
from service.commands.console import progress
from service.commands.recordings import RecordingOptions

if TYPE_CHECKING:
    from lab.evaluation.data.pairs import TraversePair
    from lab.evaluation.subject import Training


@dataclass(frozen=True)
class TruthOptions:
    """The ground truth options: one of three ways."""

    tolerance: int | None
    ground_truth: Path | None
    poses: bool
    metres: float | None
    degrees: float | None

    def check(self) -> None:
        """Check that exactly one way is chosen.

        Raises:
            typer.BadParameter: none is, or more than one.
        """
        given = [self.tolerance is not None, self.ground_truth is not None, self.poses]
        if sum(given) != 1:
            raise typer.BadParameter("give one of --tolerance, --ground-truth and --poses")
        if not self.poses and (self.metres is not None or self.degrees is not None):
            raise typer.BadParameter("--metres and --degrees go with --poses")
        if self.poses and self.metres is None:
            raise typer.BadParameter("--poses needs a distance: --metres N, and --degrees N where headings count")

    def given(self) -> bool:
        """Whether any of the options is given."""
        chosen = (self.tolerance, self.ground_truth, self.metres, self.degrees)
        return self.poses or any(value is not None for value in chosen)

    def of_counts(self, queries: int, references: int) -> Truth:
        """The truth by numbers of images alone."""
        if self.ground_truth is not None:
            return read_ground_truth(self.ground_truth, queries, references)
        return tolerance_truth(queries, references, self.tolerance or 0)

    def of_images(self, queries: list[Path], references: list[Path]) -> Truth:
        """The truth of two traverses."""
        if not self.poses:
            return self.of_counts(len(queries), len(references))
        from lab.evaluation.data.poses import read_poses, within_truth

        assert self.metres is not None, "checked"
        return within_truth(read_poses(queries), read_poses(references), self.metres, self.degrees)


@dataclass(frozen=True)
class TraverseOptions:
    """Two recordings and their truth, or a data set in a directory."""

    reference: Path | None
    query: Path | None
    truth: TruthOptions
    dataset: str | None
    data: Path | None
    reduced: bool
    limit_references: Path | None
    seed: int
    reference_frames: RecordingOptions
    query_frames: RecordingOptions

    def check(self) -> None:
        """Check that the options go together.

        Raises:
            typer.BadParameter: they do not.
        """
        if self.dataset is None:
            if self.reference is None or self.query is None:
                raise typer.BadParameter("give --reference and --query, or --dataset with --data")
            if self.data is not None or self.reduced:
                raise typer.BadParameter("--data and --reduced go with --dataset")
            self.truth.check()
        elif self.reference is not None or self.query is not None or self.truth.given():
            raise typer.BadParameter("--dataset brings its own traverses and truth: give only --data with it")
        elif self.data is None:
            raise typer.BadParameter("--dataset needs --data, the directory that holds its traverses")
        elif self.reduced and self.limit_references is not None:
            raise typer.BadParameter("--reduced and --limit-references both choose the references to keep: give one")

    def open(self, stack: ExitStack, encoder: str | None) -> TraversePair:
        """The traverses.

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
            references = _images(self.reference, self.reference_frames, stack, encoder)
            queries = _images(self.query, self.query_frames, stack, encoder)
            truth, kept = self.truth.of_images(queries, references), all_references(references)
            pair = TraversePair(name_pair(self.reference, self.query), references, queries, truth, kept)
        if self.limit_references is None:
            return pair
        kept = read_kept_references(self.limit_references, len(pair.references))
        return limit(pair, kept)


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
        return extract(bar.track(chosen, description=f"Reading {escape(path.name)}"), folder)


def name_pair(reference: Path, query: Path) -> str:
    """The name of a pair: ``nordland, winter against summer`` if both lie in one folder, else without the folder."""
    known, asked = reference.resolve(), query.resolve()
    traverses = f"{asked.name} against {known.name}"
    same = known.parent == asked.parent and known.parent.name
    return f"{known.parent.name}, {traverses}" if same else traverses


def choose_training(directory: Path | None, pair: TraversePair, seed: int) -> Training:
    """The images to learn from: those of a directory, or else the kept references.

    Raises:
        InvalidTraverse: the directory holds no image.
    """
    from lab.evaluation.subject import Training

    if directory is None:
        return Training(pair.kept_references, "the kept references", seed)
    images = find_images_below(directory)
    return Training(images, f"{len(images)} images of {directory.resolve().name}", seed)
