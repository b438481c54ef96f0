"""The table of several vocabularies, and that no pair is verified twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.geometry.keypoints import Keypoints
from lab.training import vocabularies
from lab.training.vocabularies import COLUMNS, STAGES, VerifiedPairs, best_of, table


def test_the_best_places_of_each_query_are_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vocabularies, "CANDIDATES", 2)
    chosen = best_of(np.array([[0.1, 0.3, 0.2], [0.5, 0.4, 0.5]], np.float32))
    np.testing.assert_array_equal(chosen, [[False, True, True], [True, False, True]])


def test_chosen_pairs_gain_and_are_verified_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[int]] = []

    def gains(query: Keypoints, places: list[Keypoints]) -> np.ndarray:
        asked.append([query.width, *(place.width for place in places)])
        return np.array([query.width + 0.01 * place.width for place in places], np.float32)

    monkeypatch.setattr(vocabularies, "verified_gains", gains)
    none = np.zeros((0, 2), np.uint16), np.zeros((0, 64), np.int8)
    queries, references = ([Keypoints(width, 1, *none) for width in widths] for widths in ((1, 2), (1, 2, 3)))
    scores = np.zeros((2, 3), np.float32)
    first = np.array([[True, False, True], [False, False, False]])
    made = VerifiedPairs(queries, references, tmp_path / "pairs.npy")
    np.testing.assert_allclose(made.raised(scores, first), np.array([[1.01, 0, 1.03], [0, 0, 0]]), rtol=1e-6)
    assert asked == [[1, 1, 3]]

    again = VerifiedPairs(queries, references, tmp_path / "pairs.npy")
    more = first | np.array([[False, False, False], [False, True, False]])
    np.testing.assert_allclose(again.raised(scores, more), np.array([[1.01, 0, 1.03], [0, 2.02, 0]]), rtol=1e-6)
    assert asked == [[1, 1, 3], [2, 2]]


def test_the_table_has_the_packaged_number_and_the_mean_with_half_the_spread() -> None:
    measured = {
        name: {stage: [value + 0.1 * column for column in range(len(COLUMNS))] for stage in STAGES}
        for name, value in (("packaged", 0.3), ("second", 0.2), ("third", 0.1))
    }
    lines = table(measured).splitlines()
    assert len(lines) == 2 + len(STAGES)
    assert lines[2].startswith(f"| {STAGES[0]} | 0.300; 0.200 ± 0.100 | 0.400; 0.300 ± 0.100 |")
