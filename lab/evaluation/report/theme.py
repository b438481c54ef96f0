"""Colours: of the page, of what becomes of a query, and of the systems, on light and on dark paper.

The eight hues were chosen by search: under simulated protanopia, deuteranopia and tritanopia (Machado
et al., 2009) the two nearest still lie 22 CIE Lab units apart.  From the ninth system on the hues come
again with another line style.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from lab.evaluation.report.text import plain

if TYPE_CHECKING:
    from lab.evaluation.protocol.comparison import SystemRun

Dashes = tuple[float, ...]

DASHES: tuple[Dashes, ...] = ((), (5.0, 2.0), (1.2, 1.6), (6.0, 1.6, 1.2, 1.6))
"""Lengths of ink and gap in line widths; the empty one is a solid line."""


@dataclass(frozen=True)
class Theme:
    """Colours as ``#RRGGBB``; ``tp``, ``fp``, ``tn`` and ``fn`` are the four fates of a query."""

    name: str
    paper: str
    ink: str
    muted: str
    rule: str
    tp: str
    fp: str
    tn: str
    fn: str
    hues: tuple[str, ...]


LIGHT = Theme(
    name="light",
    paper="#FFFFFF",
    ink="#1B1F24",
    muted="#5C6570",
    rule="#E3E6EA",
    tp="#014AC1",
    fp="#B33804",
    tn="#796F6F",
    fn="#8C2987",
    hues=("#014AC1", "#B33804", "#10A350", "#8C2987", "#899BE7", "#C49B00", "#670326", "#796F6F"),
)
DARK = Theme(
    name="dark",
    paper="#14171B",
    ink="#E8EAED",
    muted="#9BA3AD",
    rule="#2C3239",
    tp="#4293FB",
    fp="#F0692A",
    tn="#898A97",
    fn="#CB98E1",
    hues=("#4293FB", "#F0692A", "#18E3B5", "#CB98E1", "#B6F0FF", "#FADD48", "#CC7D6C", "#898A97"),
)


def rgb(color: str) -> tuple[int, int, int]:
    """``#RRGGBB`` as numbers from 0 to 255."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def variables(theme: Theme) -> dict[str, str]:
    """The colours of a theme by the names that they have in the page's style sheet."""
    names = ("paper", "ink", "muted", "rule", "tp", "fp", "tn", "fn")
    return {name: getattr(theme, name) for name in names} | {f"hue-{i}": hue for i, hue in enumerate(theme.hues)}


@dataclass(frozen=True)
class Mark:
    """How a system is called and drawn, the same in every chart and table.

    place: its number among all systems, from 0.
    """

    label: str
    place: int

    @property
    def hue(self) -> int:
        """Number of its hue among those of a theme."""
        return self.place % len(LIGHT.hues)

    def color(self, theme: Theme) -> str:
        """Its hue in a theme."""
        return theme.hues[self.hue]

    @property
    def dashes(self) -> Dashes:
        """Its line style."""
        return DASHES[self.place // len(LIGHT.hues) % len(DASHES)]

    @property
    def linestyle(self) -> str | tuple[int, Dashes]:
        """Its line style, as Matplotlib takes it."""
        return (0, self.dashes) if self.dashes else "-"

    @property
    def width(self) -> float:
        """Its line's width in points: the first system stands out a little."""
        return 2.0 if self.place == 0 else 1.3

    @property
    def alpha(self) -> float:
        """Its line's opacity: among many systems the later ones step back."""
        return 1.0 if self.place < len(LIGHT.hues) else 0.55


class Cast:
    """The marks of all systems of a page, by run and by name.

    Two runs of one title (the same encoder trained twice, say) are distinguished by their names, and
    those of one name too by a number.
    """

    def __init__(self, runs: Sequence[SystemRun]) -> None:
        labels = _distinguished([plain(run.about.title) for run in runs], [plain(run.about.name) for run in runs])
        self.runs = [Mark(label, place) for place, label in enumerate(labels)]
        self._names: dict[str, Mark] = {}
        for run, mark in zip(runs, self.runs, strict=True):
            self._names.setdefault(run.about.name, mark)

    def named(self, system: str) -> Mark:
        """The mark of a system by its name; one that has no run gets the next free mark."""
        if system not in self._names:
            self._names[system] = Mark(plain(system), len(self.runs) + len(set(self._names.values()) - set(self.runs)))
        return self._names[system]


def _distinguished(titles: list[str], names: list[str]) -> list[str]:
    labels = [
        f"{title} ({name})" if titles.count(title) > 1 and name != title else title
        for title, name in zip(titles, names, strict=True)
    ]
    return [
        f"{label} {labels[: index + 1].count(label)}" if labels.count(label) > 1 else label
        for index, label in enumerate(labels)
    ]


def short(mark: Mark, letters: int = 22) -> Mark:
    """The mark with a label of limited length, for where there is little room."""
    return mark if len(mark.label) <= letters else replace(mark, label=mark.label[: letters - 1].rstrip() + "…")
