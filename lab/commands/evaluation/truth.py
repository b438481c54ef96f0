"""``placerec evaluate``: the options that say what is true."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from core.frames.traverses import Truth, read_ground_truth, tolerance_truth

_option = partial(typer.Option, rich_help_panel="Ground truth (one of three ways, unless --dataset brings its own)")


@dataclass(frozen=True)
class TruthOptions:
    """The ground truth options: one of three ways."""

    tolerance: Annotated[
        int | None, _option(metavar="N", min=0, help="Query i shows the same place as references i-N to i+N.")
    ] = None
    ground_truth: Annotated[
        Path | None,
        _option(metavar="CSV", help="Rows query,reference: the true references of each query, indices from 0."),
    ] = None
    poses: Annotated[
        bool,
        _option(
            "--poses",
            help="By the poses in places.csv of both directories (as for enroll), in file names "
            "(@easting@northing@…) or in EXIF data.",
        ),
    ] = False
    metres: Annotated[
        float | None, _option(metavar="N", min=0, help="With --poses: true if at most this distance (metres) apart.")
    ] = None
    degrees: Annotated[
        float | None,
        _option(metavar="N", min=0, max=180, help="With --poses: and if headings differ by at most this angle."),
    ] = None

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
