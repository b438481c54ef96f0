"""The similarity of every query to every reference as a drawing, and what is true over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.traverses import Truth
from lab.evaluation.report.charts import house_style, make_figure, png_of
from lab.evaluation.report.theme import rgb

if TYPE_CHECKING:
    from lab.evaluation import Outcome

Drawing = NDArray[np.uint8]
TRUTH, RIGHT, WRONG = "#F5C400", "#35B6FF", "#FF6A3D"
"""On greys: outline of the true references; the best matches that are right, and wrong."""


@dataclass(frozen=True)
class Layers:
    """One drawing of a matrix: rows are queries from the top, columns retained references from the left.

    heat: uint8 [H, W], the brighter the more alike.
    truth: uint8 [H, W, 4] RGBA, the outline of the true references, transparent elsewhere.
    matches: uint8 [H, W, 4] RGBA, a square for each query's best match.
    shrunk: a pixel is less than a cell.
    """

    heat: Drawing
    truth: Drawing
    matches: Drawing
    shrunk: bool


def true_cells(truth: Truth, retained: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which retained reference is true of which query; bool [Q, R']."""
    return np.stack([np.isin(retained, true) for true in truth])


def layers(
    scores: NDArray[np.float32],
    true: NDArray[np.bool_],
    retained: NDArray[np.int64],
    outcomes: Sequence[Outcome],
    longest: int = 640,
) -> Layers:
    """The drawing of a similarity matrix; a large one is shrunk, a small one has several pixels a cell.

    Args:
        scores: float32 [Q, R'].
        true: bool [Q, R'].
        retained: int64 [R'], index of each column in the full list of references, ascending.
        outcomes: Q of them.
        longest: pixels of the drawing's longer side, at most.
    """
    height, width = scores.shape
    factor = longest / max(height, width)
    factor = float(max(1, int(factor))) if factor >= 1 else factor
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return Layers(
        _heat(scores, size), _outline(true, size), _matches(retained, outcomes, size, factor), shrunk=factor < 1
    )


def _heat(scores: NDArray[np.float32], size: tuple[int, int]) -> Drawing:
    """Greys from the 1st to the 99.8th percentile, so that one odd score does not take all the contrast."""
    shrinks = size[0] < scores.shape[1]
    values = cv2.resize(scores, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST)
    low, high = np.percentile(values, [1, 99.8])
    span = float(high - low) or 1.0
    return np.asarray(np.clip((values - low) / span, 0, 1) * 255, np.uint8)


def _outline(true: NDArray[np.bool_], size: tuple[int, int]) -> Drawing:
    """The edge, one or two pixels wide, of the cells that are true; no true cell is lost in shrinking."""
    width, height = size
    mask = np.zeros((height, width), np.uint8)
    if width < true.shape[1]:
        rows, columns = np.nonzero(true)
        mask[rows * height // true.shape[0], columns * width // true.shape[1]] = 1
    else:
        mask = np.asarray(cv2.resize(true.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST), np.uint8)
    inner = cv2.erode(mask, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    drawn = np.zeros((height, width, 4), np.uint8)
    drawn[(mask == 1) & (inner == 0)] = (*rgb(TRUTH), 255)
    return drawn


def _matches(retained: NDArray[np.int64], outcomes: Sequence[Outcome], size: tuple[int, int], factor: float) -> Drawing:
    """A square for each best match, within its cell where that is large enough; the wrong ones over the right ones."""
    drawn = np.zeros((size[1], size[0], 4), np.uint8)
    for wanted, color in ((True, RIGHT), (False, WRONG)):
        for query, outcome in enumerate(outcomes):
            if outcome.matched == wanted:
                column = int(np.searchsorted(retained, outcome.retrieved))
                drawn[_cell(query, factor), _cell(column, factor)] = (*rgb(color), 255)
    return drawn


def _cell(place: int, factor: float) -> slice:
    """Pixels of a row or column of cells: those inside it or, where cells are tiny, three around its middle."""
    if factor >= 4:
        edge = int(factor >= 8)
        return slice(round(place * factor) + edge, round((place + 1) * factor) - edge)
    middle = int((place + 0.5) * factor)
    return slice(max(0, middle - 1), middle + 2)


def png(drawing: Drawing) -> bytes:
    """A grey or RGBA drawing as a PNG file."""
    shown = cv2.cvtColor(drawing, cv2.COLOR_RGBA2BGRA) if drawing.ndim == 3 else drawing
    done, encoded = cv2.imencode(".png", shown, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert done, "any uint8 drawing can be written as PNG"
    return encoded.tobytes()


def heat_file(drawn: Layers) -> tuple[bytes, str]:
    """The greys as a file, and its media type: sharp cells as PNG, shrunk ones as the smaller JPEG."""
    if not drawn.shrunk:
        return png(drawn.heat), "image/png"
    done, encoded = cv2.imencode(".jpg", drawn.heat, [cv2.IMWRITE_JPEG_QUALITY, 82])
    assert done, "any uint8 drawing of this size can be written as JPEG"
    return encoded.tobytes(), "image/jpeg"


def matrix_file(system: str, drawn: Layers, shape: tuple[int, int]) -> bytes:
    """The three layers with axes, as a PNG file.

    Args:
        shape: Q, R'.
    """
    from matplotlib.patches import Patch
    from matplotlib.ticker import MaxNLocator

    height, width = (round(400 * side / max(drawn.heat.shape)) for side in drawn.heat.shape)
    with house_style("similarity"):
        figure = make_figure(max(260, width + 80), height + 110)
        axes = figure.add_subplot(title=f"Similarity, {system}", xlabel="retained references", ylabel="queries")
        axes.grid(False)
        extent = (-0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5)
        for layer in (cv2.cvtColor(drawn.heat, cv2.COLOR_GRAY2RGB), drawn.truth, drawn.matches):
            axes.imshow(layer, extent=extent, aspect="auto", interpolation="antialiased")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
        axes.spines[["right", "top"]].set_visible(True)
        key = [Patch(fill=False, edgecolor=TRUTH, label="true")]
        key += [Patch(color=color, label=label) for color, label in ((RIGHT, "found, right"), (WRONG, "wrong"))]
        figure.legend(handles=key, loc="outside lower left", ncols=3, handlelength=1)
        return png_of(figure)
