"""Names beside the points of a scatter plot, kept off one another."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from core.evaluation.report.drawing import LETTER, SHARPNESS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.text import Annotation
    from matplotlib.transforms import Bbox

NEAR = 6
"""Points between a dot and its name."""

DOT = 5
"""Pixels of the page around a dot that names keep off."""


@dataclass(frozen=True)
class Name:
    """What is written beside the dot at x, y (in data)."""

    text: str
    x: float
    y: float
    bold: bool = False
    color: str | None = None
    """Of the text; None for ink."""


def place_labels(axes: Axes, names: Sequence[Name], dots: Sequence[tuple[float, float]]) -> None:
    """Write each name at the first candidate that is free of other names and of dots; the first name chooses first.

    A name that stands apart from its dot is tied to it by a line.

    Args:
        dots: x, y in data of all that names must not cover, their own dots too.
    """
    from matplotlib.transforms import Bbox

    around = DOT * SHARPNESS
    taken = [
        Bbox.from_extents(x - around, y - around, x + around, y + around)
        for x, y in map(axes.transData.transform, dots)
    ]
    edge = axes.get_window_extent()
    room = Bbox.from_extents(edge.x0, edge.y0, axes.figure.bbox.x1, edge.y1 + 8 * SHARPNESS)
    for name in names:
        text = axes.annotate(
            name.text,
            (name.x, name.y),
            xytext=(NEAR, 0),
            textcoords="offset points",
            va="center_baseline",
            fontsize=LETTER - 0.5,
            fontweight="bold" if name.bold else "normal",
            annotation_clip=False,
        )
        if name.color is not None:
            text.set_color(name.color)
        offset = _choose(text, room, taken)
        taken.append(text.get_window_extent())
        if abs(offset[1]) > 8:
            _tie(axes, (name.x, name.y), offset)


def _candidates() -> Iterator[tuple[float, float, Literal["left", "right"]]]:
    """Where a name may stand, as points right and up of its dot and its alignment; the best first."""
    for rise in itertools.chain.from_iterable((step, -step) for step in range(0, 120, 4)):
        yield NEAR, float(rise), "left"
        yield -NEAR, float(rise), "right"


def _choose(text: Annotation, room: Bbox, taken: Sequence[Bbox]) -> tuple[float, float]:
    """Move the text to the first free candidate, or leave it at the last; how far it then is from its dot."""
    offset = (float(NEAR), 0.0)
    for right, rise, side in _candidates():
        offset = (right, rise)
        text.set_horizontalalignment(side)
        text.xyann = offset
        box = text.get_window_extent()
        inside = box.x0 >= room.x0 and box.x1 <= room.x1 and box.y0 >= room.y0 and box.y1 <= room.y1
        if inside and not any(box.overlaps(other) for other in taken):
            break
    return offset


def _tie(axes: Axes, dot: tuple[float, float], offset: tuple[float, float]) -> None:
    axes.annotate(
        "",
        dot,
        xytext=offset,
        textcoords="offset points",
        arrowprops={
            "arrowstyle": "-",
            "linewidth": 0.6,
            "color": axes.xaxis.label.get_color(),
            "shrinkA": 0,
            "shrinkB": 4,
        },
    )
