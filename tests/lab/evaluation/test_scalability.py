from __future__ import annotations

from pathlib import Path

import numpy as np

from core.frames.traverses import tolerance_truth
from lab.evaluation.cache import EvaluationCache
from lab.evaluation.data.pairs import TraversePair
from lab.evaluation.scalability import scalability, scale_sizes
from lab.evaluation.subject import Subject, Training
from tests.lab.evaluation.lookup import Lookup, load, write_images


def test_sizes_grow_evenly_up_to_all() -> None:
    assert scale_sizes(100, 4) == [8, 19, 43, 100]
    assert scale_sizes(1622)[-1] == 1622 and len(scale_sizes(1622)) == 6
    assert scale_sizes(5) == [5]
    assert scale_sizes(9) == [8, 9]


def made(folder: Path, count: int = 16) -> tuple[TraversePair, np.ndarray]:
    """Query i looks like reference i, but from the tenth on like reference 9."""
    table = np.eye(count, dtype=np.float32)
    shown = [min(number, 9) for number in range(count)]
    references, queries = write_images(folder / "r", range(count)), write_images(folder / "q", shown)
    return TraversePair("made", references, queries, tolerance_truth(count, count, 0), np.arange(count)), table


def test_both_traverses_grow(tmp_path: Path) -> None:
    pair, table = made(tmp_path)
    system = Lookup(table)
    points = scalability(Subject(system, pair, Training([], "nothing"), load), EvaluationCache(None))
    assert [(point.references, point.queries) for point in points] == [
        (8, 8),
        (9, 9),
        (11, 11),
        (12, 12),
        (14, 14),
        (16, 16),
    ]
    assert [point.recall_at_1 for point in points] == [1.0, 1.0, 10 / 11, 10 / 12, 10 / 14, 10 / 16]
    assert points[0].auc_pr == 1.0 and points[-1].auc_pr < 0.9
    assert all(point.milliseconds > 0 and point.system == "lookup" for point in points)
    assert system.described == 32  # each image once


def test_a_query_counts_where_a_true_reference_is_kept(tmp_path: Path) -> None:
    pair, table = made(tmp_path)
    retained = np.arange(4, 16)
    reduced = TraversePair(pair.name, pair.references, pair.queries, pair.truth, retained)
    points = scalability(Subject(Lookup(table), reduced, Training([], "nothing"), load), EvaluationCache(None))
    assert (points[0].references, points[0].queries) == (8, 8)
    assert points[0].recall_at_1 == 6 / 8  # references 4 to 11; queries 10 and 11 look like 9


def test_points_are_cached(tmp_path: Path) -> None:
    pair, table = made(tmp_path)
    cache = EvaluationCache(tmp_path / "cache")
    first = scalability(Subject(Lookup(table), pair, Training([], "nothing"), load), cache)
    system = Lookup(table)
    assert scalability(Subject(system, pair, Training([], "nothing"), load), cache) == first
    assert system.described == 0
