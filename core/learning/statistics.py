"""How a look has served since a map has it, by what later runs say; and when it is withdrawn.

A look wins a frame if it is the frame's best match and the frame is recognized.  The other frames of the run may be
certain of its place: then the look was right, or it was wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from core.belief import PlaceGraph
from core.learning.anchors import place_of
from core.learning.frames import RunFrame
from core.learning.proposals import Lesson

TOLERATED = 0.1
"""A look is withdrawn if more than this share of the frames that it wins are expected to be elsewhere."""

EXPECTED, WEIGHT = 0.05, 20.0
"""That share before anything is known, and the number of frames that this counts as (a beta distribution): two wrong
frames are enough where the look was never right, and three where it was right five times."""

IDLE = 20
"""Frames at its place that others recognized before a look that was of no help is given up."""


@dataclass(frozen=True)
class LookStatistics:
    """How a look has served.

    right, wrong: frames that it won and that their runs are certain to be at its place, and to be elsewhere.
    passed: frames that are certain to be at its place and that other looks won.
    """

    right: int = 0
    wrong: int = 0
    passed: int = 0

    def __add__(self, other: LookStatistics) -> LookStatistics:
        return LookStatistics(self.right + other.right, self.wrong + other.wrong, self.passed + other.passed)

    @property
    def misleads(self) -> bool:
        """Whether the look is to be withdrawn, because it wins frames of other places."""
        return (self.wrong + EXPECTED * WEIGHT) / (self.right + self.wrong + WEIGHT) > TOLERATED

    @property
    def idle(self) -> bool:
        """Whether the look never helps."""
        return self.right == 0 and self.passed >= IDLE


def services(
    lesson: Lesson, frames: Sequence[RunFrame], graph: PlaceGraph, looks: Mapping[int, Sequence[int]] | None = None
) -> dict[int, LookStatistics]:
    """How the rows of a map have served in a run.

    Args:
        lesson: of the run.
        frames: of the run, judged against the map.  They may have been judged anew since, as after looks were added.
        looks: all rows of each place of the graph, by number; None: ``passed`` is not counted.
    """
    found: dict[int, LookStatistics] = {}

    def count(row: int, service: LookStatistics) -> None:
        found[row] = found.get(row, LookStatistics()) + service

    for frame, certain in zip(frames, lesson.rows.tolist(), strict=True):
        if certain < 0 or frame.verdict != "recognized" or frame.row is None or frame.sight is not None:
            continue
        won, place = place_of(graph, frame.row), place_of(graph, certain)
        if won < 0 or place < 0:
            continue
        right = won in graph.same_place(place)
        count(frame.row, LookStatistics(right=int(right), wrong=int(not right)))
        if looks is not None:
            for row in looks.get(place, ()):
                if row != frame.row:
                    count(row, LookStatistics(passed=1))
    return found
