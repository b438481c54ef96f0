from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.evaluation.report.drawing import SHARPNESS, EndLabel, Sheet, label_ends, render, shares, spread
from core.evaluation.report.theme import DARK, LIGHT, Mark, Theme, rgb

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def test_spread_leaves_alone_what_is_apart() -> None:
    assert spread([10, 50, 30], 15, 0, 100) == pytest.approx([10, 50, 30])


def test_spread_parts_what_is_close() -> None:
    assert spread([50, 50], 10, 0, 100) == pytest.approx([45, 55])
    assert spread([50, 52, 90], 10, 0, 100) == pytest.approx([46, 56, 90])


def test_spread_stays_in_its_room() -> None:
    assert spread([0, 0, 100], 10, 0, 100) == pytest.approx([0, 10, 100])
    assert spread([99, 99, 99], 10, 0, 100) == pytest.approx([80, 90, 100])
    assert spread([5, 5, 5], 60, 0, 100) == pytest.approx([0, 50, 100])  # there is no room for more
    assert spread([], 10, 0, 100) == []


@given(st.lists(st.floats(-10, 110), min_size=1, max_size=30))
def test_spread_keeps_order_gap_and_room(wanted: list[float]) -> None:
    placed = spread(wanted, 3, 0, 100)
    order = np.argsort(wanted, kind="stable")
    assert (np.diff(np.array(placed)[order]) >= 3 - 1e-9).all()
    assert min(placed) >= -1e-9
    assert max(placed) <= 100 + 1e-9


def paint(axes: Axes, theme: Theme) -> None:
    shares(axes, x=True, y=True)
    axes.plot([0, 1], [0, 1], color=theme.hues[0])
    axes.set_xlabel("a $name$ with \\frac{")


def test_plot_is_drawn_on_both_papers() -> None:
    sheet = Sheet("Title", width=200, height=150)
    plot = render("name", "what it shows", sheet, paint)
    for data, theme in ((plot.light, LIGHT), (plot.dark, DARK)):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        assert image.shape == (150 * SHARPNESS, 200 * SHARPNESS, 3)
        assert tuple(image[0, 0, ::-1]) == rgb(theme.paper)
        assert tuple(image[-1, -1, ::-1]) == rgb(theme.paper)
        assert (image == np.array(rgb(theme.hues[0]))[::-1]).all(axis=2).sum() > 100


def test_settings_of_the_machine_change_nothing() -> None:
    sheet = Sheet("Title", width=200, height=150)
    plot = render("name", "", sheet, paint)
    with matplotlib.rc_context({"font.size": 30, "lines.linewidth": 9, "xtick.direction": "in"}):
        again = render("name", "", sheet, paint)
        assert matplotlib.rcParams["font.size"] == 30
    assert plot == again


def test_full_color_keeps_all_colours() -> None:
    ramp = np.arange(256, dtype=np.uint8).reshape(16, 16)
    sheet = Sheet("", width=120, height=120, full_color=True)

    def paint_ramp(axes: Axes, theme: Theme) -> None:
        axes.imshow(np.dstack([ramp, ramp, 255 - ramp]))

    plot = render("name", "", sheet, paint_ramp)
    image = cv2.imdecode(np.frombuffer(plot.light, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 256


def test_names_at_line_ends_do_not_overlap() -> None:
    sheet = Sheet("", width=400, height=300)
    boxes = []

    def names(axes: Axes, theme: Theme) -> None:
        shares(axes, x=True, y=True)
        label_ends(axes, theme, sheet, [EndLabel(Mark(f"system {place}", place), 0.5, "0.5") for place in range(8)])
        boxes.append([text.get_window_extent() for text in axes.texts])

    render("name", "", sheet, names)
    middles = sorted((box.y0 + box.y1) / 2 for box in boxes[0])
    assert len(middles) == 8
    assert np.diff(middles).min() >= 14 * SHARPNESS
