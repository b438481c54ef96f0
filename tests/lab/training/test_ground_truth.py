"""The path of most matches, and a walk whose stated truth drifts."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from lab.training.ground_truth import REACH, corrected_truth, match_count, passes, smooth_path


def test_the_path_follows_support_and_not_single_outliers() -> None:
    support = np.zeros((30, 9), np.float32)
    drift = np.clip(np.arange(30) // 8, 0, 8)
    support[np.arange(30), drift] = 1
    support[14] = 0
    support[14, 8] = 1  # one query that looks like somewhere else
    path = smooth_path(support)
    np.testing.assert_array_equal(np.delete(path, 14), np.delete(drift, 14))


def test_passes_are_followed_through_the_references() -> None:
    stated = np.zeros((6, 40), np.bool_)
    for query in range(6):
        stated[query, query + 10 : query + 13] = True
        if query >= 2:
            stated[query, query + 30 : query + 33] = True
    found = {(first, centres[0], len(centres)) for first, centres in passes(stated)}
    assert found == {(0, 11, 6), (2, 33, 4)}


def test_matches_need_a_clear_nearest() -> None:
    features = np.random.default_rng(0).random((20, 128)).astype(np.float32)
    assert match_count(features, features) == 20
    assert match_count(features, np.concatenate([features, features])) == 0
    assert match_count(features[:0], features) == 0


@pytest.mark.thorough
def test_a_drifting_truth_is_put_right() -> None:
    generator = np.random.default_rng(1)
    street = cv2.resize(generator.integers(0, 256, (60, 700, 3), np.uint8), (1400, 120), interpolation=cv2.INTER_CUBIC)

    def frame(at: float) -> NDArray[np.uint8]:
        left = int(at * 12)
        return np.ascontiguousarray(street[:, left : left + 160])

    references = [frame(n) for n in range(42)]
    queries = [frame(REACH // 2 + n * 0.8) for n in range(18)]  # slower than the stated truth believes
    stated = np.zeros((18, 42), np.bool_)
    for n in range(18):
        stated[n, REACH // 2 + n - 2 : REACH // 2 + n + 3] = True
    truth = corrected_truth(queries, references, stated)
    for n in range(4, 18):
        centre = float(np.flatnonzero(truth[n]).mean())
        assert abs(centre - (REACH // 2 + n * 0.8)) <= 1.5, n
