from __future__ import annotations

from html.parser import HTMLParser
from typing import TYPE_CHECKING

import cv2
import matplotlib
import numpy as np
import pytest

from lab.evaluation.report.charts import HEIGHT, WIDTH, draw, plot_line, shares
from lab.evaluation.report.theme import LIGHT, Mark, rgb, variables

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def paint(axes: Axes) -> None:
    shares(axes, x=True, y=True)
    for place in range(12):
        plot_line(axes, Mark(f"system <{place}> $x$", place), [0, 1], [place / 12, 1], "0.5")
    axes.set_xlabel("a $name$ with \\frac{")


class Texts(HTMLParser):
    """The text of a drawing."""

    def __init__(self, drawing: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(drawing)

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.found.append(data)


def test_the_drawing_takes_the_colours_of_the_page() -> None:
    svg = draw("name", "what it shows", "Title", paint).svg
    assert svg.startswith("<svg") and svg.rstrip().endswith("</svg>")
    for name in ("ink", "muted", "rule", "hue-2", "hue-4"):
        assert f"var(--{name})" in svg
    assert not [color for color in variables(LIGHT).values() if color.lower() in svg.lower()]


def test_text_stays_text() -> None:
    found = Texts(draw("name", "", "Title", paint).svg).found
    assert found.count("Title") == 1 and "a $name$ with \\frac{" in found
    assert [text for text in found if "system" in text] == [f"0.5  system <{place}> $x$" for place in range(12)]


def test_the_file_is_on_light_paper() -> None:
    chart = draw("name", "", "Title", paint)
    image = cv2.imdecode(np.frombuffer(chart.png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    assert tuple(image[0, 0, ::-1]) == tuple(image[-1, -1, ::-1]) == rgb(LIGHT.paper)
    assert (image == np.array(rgb(LIGHT.hues[0]))[::-1]).all(axis=2).sum() > 100


def test_drawings_of_one_page_do_not_share_names() -> None:
    """What is drawn once and used again has an id, and all drawings stand in one page."""
    first, second = (draw(name, "", "Title", lambda axes: paint_dots(axes)).svg for name in ("first", "second"))
    ids = [{part.split('"')[0] for part in svg.split(' id="')[1:]} for svg in (first, second)]
    assert ids[0] and ids[1] and not ids[0] & ids[1]


def paint_dots(axes: Axes) -> None:
    axes.plot([0, 1], [0, 1], "o")


def test_settings_of_the_machine_change_nothing() -> None:
    chart = draw("name", "", "Title", paint)
    with matplotlib.rc_context({"font.size": 30, "lines.linewidth": 9, "xtick.direction": "in"}):
        again = draw("name", "", "Title", paint)
        assert matplotlib.rcParams["font.size"] == 30
    assert chart == again


@pytest.mark.parametrize("count", [1, 20])
def test_names_have_room(count: int) -> None:
    """The layout keeps title, axes and legend apart and inside the figure."""
    boxes = []

    def many(axes: Axes) -> None:
        for place in range(count):
            plot_line(axes, Mark(f"a system of a long name {place}", place), [0, 1], [0, 1], "0.500")
        figure = axes.figure

        def measure(_event: object) -> None:
            (legend,) = figure.legends
            boxes.append((figure.bbox.frozen(), axes.get_tightbbox(), legend.get_window_extent()))

        figure.canvas.mpl_connect("draw_event", measure)

    draw("name", "", "Title", many, height=16 * count + 90)
    assert boxes
    for whole, axes_box, legend_box in boxes:
        assert axes_box is not None and axes_box.x1 <= legend_box.x0 + 1
        assert legend_box.x1 <= whole.x1 and legend_box.y0 >= whole.y0
        assert axes_box.width > 0.35 * whole.width
