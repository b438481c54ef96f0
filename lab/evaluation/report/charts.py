"""Charts by Matplotlib: each an SVG for the page, in the page's own colours, and a PNG file beside it.

Figures are made by Matplotlib's objects, without ``pyplot``: no state remains between charts, and the same comparison
gives the same bytes.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from lab.evaluation.report.text import plain
from lab.evaluation.report.theme import LIGHT, Mark, short, variables

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

DPI = 100
"""Pixels of the page per inch; of a file there are twice as many."""

WIDTH, HEIGHT = 540, 400
"""Of a chart, in pixels of the page."""

LETTER = 8.5
"""Size of the text in points."""

FIRST = "first"
"""Mark of what is drawn for the first system; its name in the legend is bold."""


@dataclass(frozen=True)
class Chart:
    """A finished chart.

    name: of its file, without suffix.
    alt: the content in words, for people who cannot see it.
    svg: an element whose colours are variables of the page's style sheet.
    png: a file, on light paper.
    """

    name: str
    alt: str
    svg: str
    png: bytes


def draw(name: str, alt: str, title: str, paint: Callable[[Axes], None], height: int = HEIGHT) -> Chart:
    """Make a chart; a legend right of it lists all that has a label, in the order in which it was painted.

    Args:
        height: in pixels of the page.
    """
    with house_style(name):
        figure = make_figure(WIDTH, height)
        axes = figure.add_subplot(title=title)
        paint(axes)
        handles, labels = axes.get_legend_handles_labels()
        if labels:
            legend = figure.legend(handles, labels, loc="outside right upper")
            for text, handle in zip(legend.get_texts(), handles, strict=True):
                text.set_fontweight("bold" if handle.get_gid() == FIRST else "normal")
        svg = _svg(figure)
        figure.set_layout_engine(None)  # what was found out for the SVG holds for the file
        return Chart(name, plain(alt), svg, png_of(figure))


def make_figure(width: int, height: int) -> Figure:
    """An empty figure of a size in pixels of the page, which finds room for all text by itself."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width / DPI, height / DPI), dpi=DPI, layout="constrained")


def png_of(figure: Figure) -> bytes:
    """A figure as a PNG file."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=2 * DPI, metadata={"Software": None})
    return stream.getvalue()


def _svg(figure: Figure) -> str:
    """A figure as an SVG element without names that would clash with those of other charts or lead out of the page."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", transparent=True)
    text = stream.getvalue()
    text = re.sub(r"<(metadata|style)\b.*?</\1>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r' (?:xmlns(?::xlink)?|width|height|version)="[^"]*"', "", text, count=5)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    names = {color.lower(): name for name, color in reversed(variables(LIGHT).items())}
    return re.sub("#[0-9a-f]{6}", lambda found: f"var(--{names[found[0]]})" if found[0] in names else found[0], text)


@contextmanager
def house_style(name: str) -> Iterator[None]:
    """Matplotlib's own defaults, whatever this machine's are, and ours over them.

    Args:
        name: of the chart; names within its SVG follow from it.
    """
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(
            {
                "axes.edgecolor": LIGHT.muted,
                "axes.facecolor": LIGHT.paper,
                "axes.grid": True,
                "axes.labelcolor": LIGHT.muted,
                "axes.axisbelow": True,
                "axes.spines.right": False,
                "axes.spines.top": False,
                "axes.titlelocation": "left",
                "axes.titlesize": LETTER + 1.5,
                "axes.titleweight": "bold",
                "axes.titlepad": 12,
                "figure.facecolor": LIGHT.paper,
                "font.size": LETTER,
                "axes.labelsize": LETTER,
                "xtick.labelsize": LETTER,
                "ytick.labelsize": LETTER,
                "legend.fontsize": LETTER - 0.5,
                "legend.frameon": False,
                "legend.handlelength": 2.4,
                "grid.color": LIGHT.rule,
                "grid.linewidth": 0.7,
                "lines.solid_capstyle": "round",
                "svg.fonttype": "none",  # text stays text, in the page's font
                "text.color": LIGHT.ink,
                "text.parse_math": False,  # a name with two dollar signs is a name
                "xtick.color": LIGHT.muted,
                "xtick.minor.size": 0,
                "ytick.color": LIGHT.muted,
                "ytick.major.size": 0,
                "ytick.minor.size": 0,
                "svg.hashsalt": name,
            }
        )
        yield


def plot_line(axes: Axes, mark: Mark, x: ArrayLike, y: ArrayLike, label: str, **style: Any) -> None:
    """A system's line, with its name in the legend; the first system lies on top and stands out a little."""
    axes.plot(
        x,
        y,
        label=f"{label}  {short(mark).label}",
        color=mark.color(LIGHT),
        linestyle=mark.linestyle,
        linewidth=mark.width,
        alpha=mark.alpha,
        zorder=3 - mark.place / 1000,
        gid=FIRST if mark.place == 0 else None,
        **style,
    )


def shares(axes: Axes, *, x: bool, y: bool) -> None:
    """Axes from 0 to 1 with five ticks, and a little air so that a line at 1 is not cut."""
    for wanted, axis, limit in ((x, axes.xaxis, axes.set_xlim), (y, axes.yaxis, axes.set_ylim)):
        if wanted:
            limit(0, 1.015)
            axis.set_ticks([0, 0.25, 0.5, 0.75, 1], ["0", "0.25", "0.5", "0.75", "1"])


def plain_log_ticks(axis: Axis) -> None:
    """1, 3, 10, 30 … on an axis that grows by factors, or 1, 2, 5, 10 … where its range is short."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    subs = (1.0, 3.0) if high / low > 30 else (1.0, 2.0, 5.0)
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
