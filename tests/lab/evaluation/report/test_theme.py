from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from core.frames.traverses import tolerance_truth
from lab.evaluation.report.theme import DARK, LIGHT, Cast, Theme, rgb, short
from tests.lab.evaluation.report.comparisons import make_comparison, make_run

# Machado, Oliveira, Fernandes, 2009, severity 1, on linear RGB.
SIGHT = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


def linear(color: str) -> NDArray[np.float64]:
    share = np.array(rgb(color)) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def lab(linear_rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIE Lab under D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = to_xyz @ linear_rgb / np.array([0.9505, 1, 1.089])
    fx, fy, fz = (np.cbrt(value) if value > 0.008856 else 7.787 * value + 16 / 116 for value in (x, y, z))
    return np.array([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)])


def contrast(a: str, b: str) -> float:
    """WCAG 2 contrast ratio."""
    light, dark = sorted((float(np.array([0.2126, 0.7152, 0.0722]) @ linear(color)) for color in (a, b)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("sight", SIGHT)
@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda theme: theme.name)
def test_hues_differ_for_every_sight(theme: Theme, sight: str) -> None:
    seen = [lab(np.clip(np.array(SIGHT[sight]) @ linear(hue), 0, 1)) for hue in theme.hues]
    assert min(float(np.linalg.norm(a - b)) for a, b in itertools.combinations(seen, 2)) > 22


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda theme: theme.name)
def test_text_stands_out_of_the_paper(theme: Theme) -> None:
    for color in (theme.ink, theme.muted, theme.tp, theme.fp, theme.tn, theme.fn):
        assert contrast(color, theme.paper) >= 4.5, color
    for hue in theme.hues:
        assert contrast(hue, theme.paper) >= 2.5, hue


def test_marks_of_thirty_two_systems_differ(tmp_path: Path) -> None:
    truth, retained = tolerance_truth(2, 2, 0), np.arange(2)
    runs = [make_run(f"s{place}", np.eye(2, dtype=np.float32), retained, truth) for place in range(32)]
    marks = Cast(runs).runs
    assert len({(mark.color(LIGHT), mark.dashes) for mark in marks}) == 32
    assert marks[0].linestyle == "-"
    assert marks[8].linestyle == (0, marks[8].dashes)


def test_systems_of_one_title_are_distinguished(tmp_path: Path) -> None:
    truth, retained, scores = tolerance_truth(2, 2, 0), np.arange(2), np.eye(2, dtype=np.float32)
    named = [("a", "Twin"), ("b", "Twin"), ("b", "Twin"), ("c", "Single")]
    runs = [make_run(name, scores, retained, truth, title=title) for name, title in named]
    assert [mark.label for mark in Cast(runs).runs] == ["Twin (a)", "Twin (b) 1", "Twin (b) 2", "Single"]


def test_a_system_has_one_mark_everywhere(tmp_path: Path) -> None:
    cast = Cast(make_comparison(tmp_path, systems=2).runs)
    assert cast.named(cast.runs[1].label) is cast.runs[1]
    unknown = cast.named("elsewhere")
    assert unknown.place == 2
    assert cast.named("elsewhere") is unknown
    assert cast.named("further").place == 3


def test_short_keeps_the_mark(tmp_path: Path) -> None:
    mark = Cast(make_comparison(tmp_path, systems=1).runs).runs[0]
    assert short(mark) is mark
    assert short(mark, 5) == type(mark)("syst…", mark.place)
