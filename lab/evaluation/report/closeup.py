"""One system by itself: its similarity matrix, its scores, its matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab.evaluation.report.charts import Chart
from lab.evaluation.report.gallery import Group, gallery
from lab.evaluation.report.matrix import heat_file, layers, matrix_file, png, true_cells
from lab.evaluation.report.theme import Mark
from lab.evaluation.report.threshold_effects import plot_fates
from lab.evaluation.report.thumbnails import Thumbnails, data_uri

if TYPE_CHECKING:
    from lab.evaluation.protocol.comparison import SystemComparison, SystemRun


@dataclass(frozen=True)
class Closeup:
    """The part of a run that the page shows.

    constants: of the system, as text.
    layers: addresses that hold the drawings of the matrix: heat, true references, best matches.
    size: their width and height in pixels.
    fates: the scores before and, where there is a threshold, after it.
    similarity: the matrix as a file.
    stem: the end of the names of its files.
    """

    run: SystemRun
    mark: Mark
    stem: str
    constants: Sequence[tuple[str, str]]
    layers: Sequence[str]
    size: tuple[int, int]
    fates: Sequence[Chart]
    groups: Sequence[Group]
    similarity: bytes

    @property
    def has_regions(self) -> bool:
        """Whether regions of interest are drawn on some image."""
        return any(panel.boxes for group in self.groups for panels in group.cases for panel in panels)


def closeup(comparison: SystemComparison, run: SystemRun, mark: Mark, stem: str, thumbnails: Thumbnails) -> Closeup:
    """Everything about one run.

    Args:
        stem: the end of the names of its files.
    """
    drawn = layers(
        run.scores,
        true_cells(comparison.truth, comparison.retained),
        comparison.retained,
        run.outcomes,
        longest=640 if len(comparison.runs) <= 6 else 448,
    )
    rule = run.evaluation.thresholds[0] if run.evaluation.thresholds else None
    constants = [(name, _constant(value)) for name, value in run.about.configuration.items()]
    constants += [("trained on", run.evaluation.trained_on)] if run.evaluation.trained_on else []
    height, width = drawn.heat.shape
    return Closeup(
        run,
        mark,
        stem,
        constants,
        [data_uri(*heat_file(drawn)), *(data_uri(png(one), "image/png") for one in (drawn.truth, drawn.matches))],
        (width, height),
        plot_fates(stem, mark.label, run.outcomes, None if rule is None else rule.threshold),
        gallery(
            comparison,
            run,
            thumbnails,
            comparison.regions if comparison.regions_of in (None, run.identity) else None,
            most=min(12, max(4, 36 // len(comparison.runs) * 2)),
        ),
        matrix_file(mark.label, drawn, (len(run.outcomes), len(comparison.retained))),
    )


def _constant(value: object) -> str:
    return " ".join(str(item) for item in value) if isinstance(value, tuple | list) else str(value)
