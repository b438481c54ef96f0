"""The compiled search finds the path that the search by rows in NumPy finds, to the last bit of its sum."""

from __future__ import annotations

import numpy as np

from core.judgement.alignment import AlignedPairs, best_pairs, best_path, best_path_by_rows, of_matrix


def pairs_of(seed: int) -> AlignedPairs:
    """Pairs of some frames, few or many of each, with a path among them, and rows that are not free."""
    random = np.random.default_rng(seed)
    rows, columns = random.integers(1, 60, 2)
    scores = random.random((rows, columns)).round(int(random.integers(1, 8)))  # many are equal if rounded
    along = np.arange(min(rows, columns))
    scores[along, along] += random.random()
    pairs = best_pairs(of_matrix(scores)(np.arange(rows)), int(rows), int(columns))
    if len(pairs.columns[0]) > 3:
        chosen = np.sort(random.permuted(np.tile(np.arange(pairs.columns.shape[1]), (rows, 1)), axis=1)[:, :3], axis=1)
        if seed % 2:
            pairs = AlignedPairs(
                np.take_along_axis(pairs.columns, chosen, axis=1),
                np.take_along_axis(pairs.gains, chosen, axis=1),
                pairs.others,
                pairs.free,
            )
    return pairs.without(random.integers(0, rows, seed % 4))


def test_paths_are_those_found_by_rows() -> None:
    lengths = set()
    for seed in range(60):
        for pairs in (pairs_of(seed), pairs_of(seed).turned_around()):
            path, total = best_path(pairs)
            plain, sum_by_rows = best_path_by_rows(pairs)
            assert total == sum_by_rows and path.tolist() == plain.tolist(), seed
            lengths.add(len(path))
    assert len(lengths) > 10


def test_without_a_gain_there_is_no_path() -> None:
    nothing = AlignedPairs(np.zeros((3, 1), np.int64), np.full((3, 1), -1.0), 1, np.ones(3, np.bool_))
    path, total = best_path(nothing)
    assert path.shape == (0, 2) and total == 0
