from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.evaluation.report.gallery import MOST_BOXES, case, gallery, wrong_first
from lab.evaluation.report.thumbnails import Thumbnails
from tests.lab.evaluation.report.comparisons import make_comparison, make_run, outcome


def test_the_most_confident_wrong_match_is_first() -> None:
    outcomes = [outcome(0.5), outcome(0.9, matched=True), outcome(0.8), outcome(0.7, negative=True), outcome(0.8)]
    assert wrong_first(outcomes, 3, 5) == [2, 4, 3, 1]
    assert wrong_first(outcomes, 0, 0) == []


def test_right_matches_are_spaced_from_sure_to_unsure() -> None:
    outcomes = [outcome(score, matched=True) for score in (0.1, 0.5, 0.3, 0.2, 0.4)]
    assert wrong_first(outcomes, 5, 3) == [1, 2, 0]
    assert wrong_first(outcomes, 5, 9) == [1, 4, 2, 3, 0]
    assert wrong_first(outcomes, 5, 1) == [1]


def test_which_true_reference_is_shown(tmp_path: Path) -> None:
    retained = np.array([0, 2, 4, 5])
    truth = [np.array([0, 2, 4]), np.array([0, 2, 4]), np.array([1, 3]), np.array([], np.int64)]
    scores = np.array([[0.9, 0.1, 0.2, 0.0], [0.3, 0.1, 0.4, 0.8], [0.0, 0.0, 0.0, 0.7], [0.6, 0, 0, 0]], np.float32)
    comparison = replace(make_comparison(tmp_path, systems=1), retained=retained, truth=truth)
    run = make_run("hand", scores, retained, truth)
    shown = [case(comparison, run, query) for query in range(4)]
    assert [(one.truth, one.truth_score) for one in shown] == [
        (2, float(scores[0, 1])),  # right: the middle of the true ones
        (4, float(scores[1, 2])),  # wrong: the best of the true ones
        (3, None),  # none of the true ones was retained
        (None, None),
    ]


def test_number_of_cases_and_of_boxes_is_bounded(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, systems=1, noise=6.0, count=30)
    boxes = [(0.0, 0.0, 1.0, (place + 1) / 100) for place in range(100)]
    groups = gallery(comparison, comparison.runs[0], Thumbnails(), lambda path: boxes, most=4)
    assert [(group.kind, len(group.cases)) for group in groups] == [("wrong", 4), ("right", 2)]
    panels = [panel for group in groups for case in group.cases for panel in case]
    assert [len(panel.boxes) for panel in panels] == [MOST_BOXES] * 18
    assert panels[0].boxes[9] == pytest.approx((0.0, 0.0, 48.0, 3.6)), "pixels of the picture"
