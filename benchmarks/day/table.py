"""The table of a day: a row for each situation, a column for each mode."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.day.drive import LETTERS, DriveOutcomes, Outcome
from benchmarks.day.robots import Mode
from benchmarks.report import report

SHOWN: tuple[Outcome, ...] = ("right", "wrong", "ambiguous", "unknown")
BESIDE: tuple[Outcome, ...] = ("nowhere", "silent")
TITLE = (
    "A day on {}: frames recognized and right/wrong, ambiguous/unknown; n: unknown where the map has nothing, "
    "-: without an answer; seconds until right again"
)


@dataclass(frozen=True)
class Row:
    """One situation in one mode."""

    situation: str
    mode: Mode
    drive: DriveOutcomes

    def cell(self) -> str:
        """As it is shown: right/wrong/ambiguous/unknown, other outcomes, and the seconds until right again."""
        counts = "/".join(str(self.drive.count(one)) for one in SHOWN)
        more = [f"+{count}{LETTERS[one]}" for one in BESIDE if (count := self.drive.count(one))]
        return " ".join([counts, *more, *([seconds(self.drive.again)] if self.drive.again is not None else [])])

    def figures(self) -> dict[str, Any]:
        """The outcomes as they are stored; the trail has a letter for each frame."""
        again = self.drive.again
        return {
            "situation": self.situation,
            "mode": str(self.mode),
            "frames": len(self.drive.outcomes),
            **{one: self.drive.count(one) for one in LETTERS},
            "right_again_after_seconds": "never" if again == math.inf else again,
            "trail": self.drive.trail,
        }


def seconds(again: float) -> str:
    """Seconds as they are shown."""
    return "never" if math.isinf(again) else f"{again:.3g} s"


def show(walk: str, rows: Sequence[Row], to: Path | None) -> None:
    """Print the table and keep the figures, in a file of their own as well if one is named."""
    figures = {"walk": walk, "rows": [row.figures() for row in rows]}
    modes = list(dict.fromkeys(row.mode for row in rows))
    cells = {(row.situation, row.mode): row.cell() for row in rows}
    names = dict.fromkeys(row.situation for row in rows)
    table = [(name, *(cells[name, mode] for mode in modes)) for name in names]
    report(f"day-{walk}", TITLE.format(walk), ("situation", *map(str, modes)), table, figures)
    if to is not None:
        to.write_text(json.dumps(figures, indent=2) + "\n")
