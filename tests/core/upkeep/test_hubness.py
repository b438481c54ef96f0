"""Hubs are found where there are some, and not where there are none."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.upkeep.hubness import NONE, hubs, nearest_others, occurrences, skewness


def neighbours(descriptors: NDArray[np.float64], k: int) -> NDArray[np.int64]:
    scores = (descriptors @ descriptors.T).astype(np.float32)
    return np.stack([nearest_others(row, np.arange(len(row)) == i, k)[0] for i, row in enumerate(scores)])


@given(st.integers(1, 12), st.integers(1, 6), st.integers(0, 3))
def test_every_entry_is_counted_once(places: int, k: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    found = neighbours(random.normal(size=(places, 4)), k)
    counts = occurrences(found, places)
    assert counts.sum() == places * min(k, places - 1) == (found != NONE).sum()


def test_a_planted_hub_is_found() -> None:
    random = np.random.default_rng(1)
    shared = random.normal(size=64)  # what all places have in common, such as the same grey floor
    descriptors = shared + random.normal(size=(200, 64))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    plain = occurrences(neighbours(descriptors, 5), 200)
    descriptors[17] = shared / np.linalg.norm(shared)  # shows nothing else
    counts = occurrences(neighbours(descriptors, 5), 200)
    assert hubs(counts)[0] == 17
    assert counts[17] > 60
    assert skewness(counts) > skewness(plain) + 2


def test_where_all_are_alike_there_is_none() -> None:
    assert hubs(np.full(50, 5)).tolist() == []
    assert hubs(np.empty(0, np.int64)).tolist() == []
    assert skewness(np.full(50, 5)) == skewness(np.empty(0, np.int64)) == 0.0


def test_chance_alone_makes_no_hub() -> None:
    random = np.random.default_rng(3)
    drawn = np.stack([random.choice(1000, 10, replace=False) for _ in range(1000)])
    assert len(hubs(occurrences(drawn, 1000))) <= 1


def test_nearest_others_leave_the_place_itself_out() -> None:
    scores = np.array([0.9, 0.8, 0.3, 0.5], np.float32)
    places, found = nearest_others(scores, np.array([True, True, False, False]), 3)
    assert places.tolist() == [3, 2, NONE]
    assert found[:2].tolist() == [np.float32(0.5), np.float32(0.3)]
