"""Which frames of one traverse show the places of another."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from core.judgement import alignment
from core.judgement.alignment import (
    LARGEST,
    LEAST_FRAMES,
    ORDINARY,
    AlignedPairs,
    SharedStretch,
    best_pairs,
    best_path,
    of_matrix,
    shared_stretches,
)

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


def shared(scores: Values) -> list[SharedStretch]:
    return shared_stretches(of_matrix(scores), *scores.shape)


def test_a_shared_stretch_is_found_at_a_changing_pace() -> None:
    first = np.arange(20, 80)
    second = 10 + np.cumsum(np.where(np.arange(60) < 30, 1, 2))
    (found,) = shared(with_path(ordinary(120, 140), first, second))
    paired = dict(zip(found.first.tolist(), found.second.tolist(), strict=True))
    right = [abs(paired[a] - b) <= 2 for a, b in zip(first.tolist(), second.tolist(), strict=True) if a in paired]
    assert len(right) >= 55 and np.mean(right) > 0.95
    assert (np.diff(found.first) == 1).all()
    assert ((np.diff(found.second) >= 0) & (np.diff(found.second) <= 3)).all()
    assert found.gain > 1


def test_two_stretches_are_found_best_first() -> None:
    scores = with_path(ordinary(160, 160), np.arange(60), 90 + np.arange(60))
    scores = with_path(scores, 100 + np.arange(35), np.arange(35))
    long, short = shared(scores)
    assert len(long.first) >= 55 and len(short.first) >= 30
    assert not np.intersect1d(long.first, short.first).size


@pytest.mark.parametrize("seed", range(5))
def test_traverses_that_share_nothing_have_no_stretch(seed: int) -> None:
    assert shared(ordinary(90, 130, seed)) == []


def test_places_in_the_other_order_are_no_stretch() -> None:
    scores = with_path(ordinary(100, 100), np.arange(80), 80 - np.arange(80))
    assert shared(scores) == []


@pytest.mark.parametrize("shape", [(0, 0), (0, 50), (LEAST_FRAMES - 1, 50), (50, LEAST_FRAMES - 1)])
def test_a_few_frames_are_no_evidence(shape: tuple[int, int]) -> None:
    assert shared(np.ones(shape)) == []


def test_scores_that_are_all_alike_share_nothing() -> None:
    assert shared(np.full((30, 40), 0.3)) == []


def test_frames_and_places_that_resemble_everything_do_not_count() -> None:
    rows, columns = np.random.default_rng(0).normal(size=(2, 50))
    found = best_pairs(lambda at: rows[:, None] + columns[at], 50, 50)
    assert found.gains.max() == pytest.approx(-ORDINARY, abs=1e-3)


def every_pair(gains: Values) -> AlignedPairs:
    rows, others = gains.shape
    return AlignedPairs(np.tile(np.arange(others), (rows, 1)), gains, others, np.ones(rows, np.bool_))


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
        path, total = best_path(every_pair(gains))
        steps = np.diff(path[:, 1])
        assert total == pytest.approx(expected)
        assert gains[path[:, 0], path[:, 1]].sum() - 0.5 * np.abs(steps - 1).sum() == pytest.approx(total)
        (turned, back) = (best_path(every_pair(gains[:, ::-1])), best_path(every_pair(gains).turned_around()))
        assert turned[1] == pytest.approx(back[1]) and (turned[0] == back[0]).all()
    assert best_path(every_pair(np.full((4, 4), -1.0)))[1] == 0


def test_a_path_goes_on_through_pairs_that_were_not_kept() -> None:
    """They count as ordinary ones, as long as the sum stays positive."""
    columns = np.array([[2, 8], [3, 9], [0, 7], [5, 6]])
    gains = np.array([[2.0, 0.1], [2.0, 0.1], [-1.0, -1.0], [2.0, 0.1]])
    path, total = best_path(AlignedPairs(columns, gains, 10, np.ones(4, np.bool_)))
    assert path.tolist() == [[0, 2], [1, 3], [2, 4], [3, 5]]
    assert total == pytest.approx(6 - ORDINARY)


@pytest.mark.parametrize(("together", "tile", "kept"), [(40, 512, 512), (1024, 30, 512), (1024, 512, 20), (45, 25, 25)])
def test_a_long_traverse_is_matched_in_pieces(
    monkeypatch: pytest.MonkeyPatch, together: int, tile: int, kept: int
) -> None:
    """In pieces, tiles and with few pairs the same frames are paired; no more than a tile is asked for at once."""
    first, second = np.arange(20, 110), 30 + np.arange(90)
    scores = with_path(ordinary(140, 150), first, second)
    for name, value in (("TOGETHER", together), ("TILE", tile), ("MOST_PAIRS", kept), ("SAMPLE", 60)):
        monkeypatch.setattr(alignment, name, value)
    asked: list[tuple[int, int]] = []
    told: list[int] = []

    def piecewise(rows: Frames) -> Callable[[Frames], Values]:
        def against(columns: Frames) -> Values:
            asked.append((len(rows), len(columns)))
            return np.asarray(scores[np.ix_(rows, columns)])

        return against

    found = shared_stretches(piecewise, 140, 150, told.append)
    paired = {a: b for one in found for a, b in zip(one.first.tolist(), one.second.tolist(), strict=True)}
    right = [abs(paired[a] - b) <= 2 for a, b in zip(first.tolist(), second.tolist(), strict=True) if a in paired]
    assert len(right) >= 80 and np.mean(right) > 0.95
    assert max(rows for rows, _ in asked) <= together and max(columns for _, columns in asked) <= max(tile, 60)
    assert sum(told) == 140 * 150
    assert [one.total for one in found] == sorted((one.total for one in found), reverse=True)
    assert all(one.gain <= LARGEST - ORDINARY for one in found)


def test_what_the_callback_raises_ends_the_search() -> None:
    def stop(pairs: int) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        shared_stretches(of_matrix(ordinary(30, 30)), 30, 30, stop)
