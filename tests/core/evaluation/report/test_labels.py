from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from core.evaluation.report.drawing import SHARPNESS, Sheet, paint_png
from core.evaluation.report.labels import Name, place_labels
from core.evaluation.report.theme import LIGHT, Theme

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def test_names_keep_off_one_another_and_off_dots() -> None:
    points = [(0.5, 0.5), (0.5, 0.52), (0.52, 0.5), (0.98, 0.5), (0.98, 0.98), (0.02, 0.02)]
    found = []

    def paint(axes: Axes, theme: Theme) -> None:
        axes.set(xlim=(0, 1), ylim=(0, 1))
        place_labels(axes, [Name(f"a long name {place}", x, y) for place, (x, y) in enumerate(points)], points)
        boxes = [text.get_window_extent() for text in axes.texts if text.get_text()]
        dots = axes.transData.transform(points)
        assert len(boxes) == len(points)
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
        assert not any(box.contains(x, y) for box in boxes for x, y in dots)
        assert all(box.x1 <= axes.figure.bbox.x1 and box.x0 >= 0 for box in boxes)
        found.append(True)

    paint_png(Sheet("", width=500, height=300), LIGHT, paint)
    assert found


def test_a_lone_name_stands_right_of_its_dot() -> None:
    def paint(axes: Axes, theme: Theme) -> None:
        axes.set(xlim=(0, 1), ylim=(0, 1))
        place_labels(axes, [Name("one", 0.5, 0.5, bold=True, color=theme.fp)], [(0.5, 0.5)])
        x, y = axes.transData.transform((0.5, 0.5))
        box = axes.texts[0].get_window_extent()
        assert 5 < (box.x0 - x) / SHARPNESS < 15
        assert box.y0 < y < box.y1
        assert (axes.texts[0].get_color(), axes.texts[0].get_fontweight()) == (theme.fp, "bold")

    paint_png(Sheet("", width=500, height=300), LIGHT, paint)
