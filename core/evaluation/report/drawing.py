"""Plots as PNG files, each on light and on dark paper.

Figures are made by Matplotlib's objects and its Agg canvas, without ``pyplot``: nothing is kept between
plots, and the same comparison gives the same bytes.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image  # Matplotlib brings it, and writes its own images with it

from core.evaluation.report.theme import DARK, LIGHT, Mark, Theme, rgb, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Pixels = NDArray[np.uint8]
"""H x W x 3, red, green, blue."""

DPI = 100
SHARPNESS = 2
"""Pixels of the file per pixel of the page."""

SHADES = 6
"""Of each ink, where it meets the paper: more cannot be told apart, and take a fifth more bytes."""

LETTER = 8.5
"""Size of the text in points."""


@dataclass(frozen=True)
class Plot:
    """A finished plot.

    name: of its file, without suffix.
    alt: what it shows, for who cannot see it.
    width, height: in pixels of the page.
    light, dark: PNG files.
    """

    name: str
    alt: str
    width: int
    height: int
    light: bytes
    dark: bytes


@dataclass(frozen=True)
class Margins:
    """Pixels of the page between the axes and the edges of the plot."""

    left: int = 58
    right: int = 16
    top: int = 34
    bottom: int = 42


@dataclass(frozen=True)
class Sheet:
    """Empty paper of a size in pixels of the page, and what surrounds its axes."""

    title: str
    width: int = 540
    height: int = 400
    margins: Margins = Margins()
    full_color: bool = False
    """It holds more colours than the theme's."""

    @property
    def inner_height(self) -> int:
        """Pixels between the bottom and the top of the axes."""
        return self.height - self.margins.top - self.margins.bottom

    @property
    def inner_width(self) -> int:
        """Pixels between the left and the right of the axes."""
        return self.width - self.margins.left - self.margins.right


def render(name: str, alt: str, sheet: Sheet, paint: Callable[[Axes, Theme], None]) -> Plot:
    """Paint the plot once for each theme."""
    light, dark = (paint_png(sheet, theme, paint) for theme in (LIGHT, DARK))
    return Plot(name, alt, sheet.width, sheet.height, light, dark)


def paint_png(sheet: Sheet, theme: Theme, paint: Callable[[Axes, Theme], None]) -> bytes:
    """The plot in one theme, as a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with _house_style(theme):
        figure = _figure(sheet)
        FigureCanvasAgg(figure)  # before it is painted: names are measured on it
        axes = figure.axes[0]
        paint(axes, theme)
        axes.set_title(sheet.title, loc="left", pad=12, color=theme.ink, fontsize=LETTER + 1.5, fontweight="bold")
        stream = io.BytesIO()
        figure.savefig(stream, format="rgba", dpi="figure")
        size = sheet.height * SHARPNESS, sheet.width * SHARPNESS
        pixels = np.frombuffer(stream.getvalue(), np.uint8).reshape(*size, 4)[..., :3]
        return _full_color(pixels) if sheet.full_color else _indexed(pixels, theme)


def _full_color(pixels: Pixels) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, format="png")
    return stream.getvalue()


def _indexed(pixels: Pixels, theme: Theme) -> bytes:
    """A PNG file of few colours, which has a fifth of the bytes."""
    palette = _palette(theme)
    red, green, blue = (pixels[..., channel].astype(np.uint32) for channel in range(3))
    packed = red << 16 | green << 8 | blue
    nearest = np.zeros(1 << 24, np.uint8)  # of every colour its place in the palette; a table is faster than sorting
    nearest[packed] = 1
    colors = np.flatnonzero(nearest)
    channels = np.stack([colors >> 16, colors >> 8 & 255, colors & 255], axis=1).astype(np.float32)  # U x 3
    # |c - p|² less |c|², which is the same for every p.
    nearest[colors] = (np.square(palette).sum(axis=1) - 2 * channels @ palette.T).argmin(axis=1)
    image = Image.fromarray(nearest[packed])
    image.putpalette(np.round(palette).astype(np.uint8).tobytes())
    stream = io.BytesIO()
    image.save(stream, format="png", optimize=True)
    return stream.getvalue()


def _palette(theme: Theme) -> NDArray[np.float32]:
    """float32 [C <= 256, 3], red, green, blue: ramps from the paper to every ink, as smooth edges need."""
    inks = dict.fromkeys((theme.ink, theme.muted, theme.rule, theme.tp, theme.fp, theme.tn, theme.fn, *theme.hues))
    paper = np.array(rgb(theme.paper), np.float32)
    steps = np.linspace(0, 1, SHADES + 1, dtype=np.float32)[1:, None]
    ramps = [paper + steps * (np.array(rgb(ink), np.float32) - paper) for ink in inks]
    return np.concatenate([paper[None], *ramps])


def _figure(sheet: Sheet) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(sheet.width / DPI, sheet.height / DPI), dpi=DPI * SHARPNESS)
    margins = sheet.margins
    figure.add_axes(
        (
            margins.left / sheet.width,
            margins.bottom / sheet.height,
            sheet.inner_width / sheet.width,
            sheet.inner_height / sheet.height,
        )
    )
    return figure


@contextmanager
def _house_style(theme: Theme) -> Iterator[None]:
    """Matplotlib's own defaults, whatever this machine's are, and ours over them."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(
            {
                "axes.edgecolor": theme.muted,
                "axes.facecolor": theme.paper,
                "axes.grid": True,
                "axes.labelcolor": theme.muted,
                "axes.labelsize": LETTER,
                "axes.axisbelow": True,
                "axes.linewidth": 0.8,
                "axes.spines.right": False,
                "axes.spines.top": False,
                "figure.facecolor": theme.paper,
                "font.family": "DejaVu Sans",
                "font.size": LETTER,
                "grid.color": theme.rule,
                "grid.linewidth": 0.7,
                "lines.solid_capstyle": "round",
                "savefig.facecolor": theme.paper,
                "text.color": theme.ink,
                "text.parse_math": False,  # a name with two dollar signs is a name
                "xtick.color": theme.muted,
                "xtick.labelsize": LETTER,
                "xtick.major.size": 3,
                "xtick.minor.size": 0,
                "ytick.color": theme.muted,
                "ytick.labelsize": LETTER,
                "ytick.major.size": 0,
                "ytick.minor.size": 0,
            }
        )
        yield


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


def spread(wanted: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Positions at least ``gap`` apart within ``low`` to ``high``, in the order of, and nearest to, the wanted ones.

    Least squares: the i-th smallest less i·gap must not fall, which pooling of adjacent violators solves.
    Where not all fit, they are evenly spaced over the whole room.
    """
    if not wanted:
        return []
    gap = min(gap, (high - low) / max(1, len(wanted) - 1))
    order = sorted(range(len(wanted)), key=lambda index: wanted[index])
    blocks: list[tuple[float, int]] = []  # mean and length of a run of equal values
    for step, index in enumerate(order):
        block = (wanted[index] - step * gap, 1)
        while blocks and blocks[-1][0] > block[0]:
            mean, length = blocks.pop()
            total = length + block[1]
            block = ((mean * length + block[0] * block[1]) / total, total)
        blocks.append(block)
    level = [mean for mean, length in blocks for _ in range(length)]
    free = np.clip(level, low, high - (len(wanted) - 1) * gap)
    placed = [0.0] * len(wanted)
    for step, index in enumerate(order):
        placed[index] = float(free[step]) + step * gap
    return placed


@dataclass(frozen=True)
class EndLabel:
    """What is written beside the axes for a line that ends at the height ``y`` (in data)."""

    mark: Mark
    y: float
    number: str
    """A number, written before the name."""


def label_ends(
    axes: Axes, theme: Theme, sheet: Sheet, labels: Sequence[EndLabel], *, leaders: bool = True, letters: int = 22
) -> None:
    """Names at the right of the axes, each as near to its line's end as the others let it be.

    Args:
        leaders: draw from the line's end at the right edge of the axes to its name; without, the names are a key.
    """
    to_axes = axes.transData + axes.transAxes.inverted()
    ends = [float(to_axes.transform((axes.get_xlim()[1], label.y))[1]) for label in labels]
    pixels = [end * sheet.inner_height for end in ends]
    heights = spread(pixels, 14.5, 4, sheet.inner_height - 2)
    for label, pixel, height in zip(labels, pixels, heights, strict=True):
        color, end = label.mark.color(theme), height / sheet.inner_height
        start = pixel / sheet.inner_height if leaders else end
        inward = 0 if leaders else 6
        x = [(sheet.inner_width + offset) / sheet.inner_width for offset in (inward, 14, 24)]
        axes.plot(
            x,
            [start, end, end],
            transform=axes.transAxes,
            clip_on=False,
            color=color,
            linewidth=1.0 if leaders else label.mark.width,
            linestyle=label.mark.linestyle,
        )
        axes.annotate(
            f"{label.number}  {short(label.mark, letters).label}",
            (x[-1], end),
            xycoords="axes fraction",
            xytext=(4, 0),
            textcoords="offset points",
            va="center_baseline",
            fontsize=LETTER - 0.5,
            fontweight="bold" if label.mark.place == 0 else "normal",
            annotation_clip=False,
        )
