"""Which frames of one traverse show the places of another."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from core.judgement.alignment import LEAST_FRAMES, best_path, comparable, shared_stretches

Values = NDArray[np.float64]
Frames = NDArray[np.int64]


def ordinary(rows: int, columns: int, seed: int = 0) -> Values:
    """Scores of unrelated frames, some of which resemble everything."""
    random = np.random.default_rng(seed)
    hubs = random.normal(0, 0.05, rows)[:, None] + random.normal(0, 0.05, columns)
    return 0.2 + hubs + random.normal(0, 0.02, (rows, columns))


def with_path(scores: Values, first: Frames, second: Frames) -> Values:
    scores = scores.copy()
    scores[first, second] += 0.08
    return scores


def test_a_shared_stretch_is_found_at_a_changing_pace() -> None:
    first = np.arange(20, 80)
    second = 10 + np.cumsum(np.where(np.arange(60) < 30, 1, 2))
    (found,) = shared_stretches(with_path(ordinary(120, 140), first, second))
    paired = dict(zip(found.first.tolist(), found.second.tolist(), strict=True))
    right = [abs(paired[a] - b) <= 2 for a, b in zip(first.tolist(), second.tolist(), strict=True) if a in paired]
    assert len(right) >= 55 and np.mean(right) > 0.95
    assert (np.diff(found.first) == 1).all()
    assert ((np.diff(found.second) >= 0) & (np.diff(found.second) <= 3)).all()
    assert found.gain > 1


def test_two_stretches_are_found_best_first() -> None:
    scores = with_path(ordinary(160, 160), np.arange(60), 90 + np.arange(60))
    scores = with_path(scores, 100 + np.arange(35), np.arange(35))
    long, short = shared_stretches(scores)
    assert len(long.first) >= 55 and len(short.first) >= 30
    assert not np.intersect1d(long.first, short.first).size


@pytest.mark.parametrize("seed", range(5))
def test_traverses_that_share_nothing_have_no_stretch(seed: int) -> None:
    assert shared_stretches(ordinary(90, 130, seed)) == []


def test_places_in_the_other_order_are_no_stretch() -> None:
    scores = with_path(ordinary(100, 100), np.arange(80), 80 - np.arange(80))
    assert shared_stretches(scores) == []


@pytest.mark.parametrize("shape", [(0, 0), (0, 50), (LEAST_FRAMES - 1, 50), (50, LEAST_FRAMES - 1)])
def test_a_few_frames_are_no_evidence(shape: tuple[int, int]) -> None:
    assert shared_stretches(np.ones(shape)) == []


def test_scores_that_are_all_alike_share_nothing() -> None:
    assert shared_stretches(np.full((30, 40), 0.3)) == []


def test_frames_and_places_that_resemble_everything_do_not_count() -> None:
    rows, columns = np.random.default_rng(0).normal(size=(2, 50))
    assert comparable(rows[:, None] + columns).max() == pytest.approx(0, abs=1e-9)


def test_the_best_path_is_the_best_of_all() -> None:
    """By trying every path of a few small tables."""

    def total_from(gains: Values, row: int, column: int) -> float:
        further = [0.0]
        if row + 1 < len(gains):
            further += [
                total_from(gains, row + 1, column + step) - 0.5 * abs(step - 1)
                for step in range(4)
                if column + step < gains.shape[1]
            ]
        return float(gains[row, column]) + max(further)

    for seed in range(5):
        gains = np.random.default_rng(seed).normal(-0.3, 1, (5, 6))
        expected = max(total_from(gains, row, column) for row in range(5) for column in range(6))
        path, total = best_path(gains)
        steps = np.diff(path[:, 1])
        assert total == pytest.approx(expected)
        assert gains[path[:, 0], path[:, 1]].sum() - 0.5 * np.abs(steps - 1).sum() == pytest.approx(total)
    assert best_path(np.full((4, 4), -1.0))[1] == 0
