"""The scores of two traverses, the scale of their picture, and what poses and stations say of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from core.places import GEOGRAPHIC, METRIC, NO_POSE, NO_SEQUENCE, Neighborhood, Whereabouts
from core.upkeep.similarity import NONE, GreyScale, counterparts, nearest_by_pose, stretches_of

SCORES = arrays(np.float32, st.tuples(st.integers(1, 7), st.integers(1, 7)), elements=st.floats(-2, 2, width=32))


@given(SCORES)
def test_a_value_tells_its_score_within_half_a_step(scores: NDArray[np.float32]) -> None:
    scale = GreyScale.of(scores)
    told = scale.low + scale.values(scores) / 255 * (scale.high - scale.low)
    assert np.abs(told - scores).max() <= (scale.high - scale.low) / 255 * 0.5001 + 1e-6


def test_equal_scores_and_no_scores_have_a_scale() -> None:
    assert not GreyScale.of(np.ones((2, 3), np.float32)).values(np.ones((2, 3), np.float32)).any()
    assert GreyScale.of(np.empty((0, 3), np.float32)) == GreyScale(0.0, 0.0)


@pytest.mark.parametrize("times", [1, 5])
def test_a_shared_way_is_found_whichever_traverse_is_the_longer(times: int) -> None:
    random = np.random.default_rng(0)
    shown = np.arange(40 * times) // times
    scores = random.normal(0, 1, (40, 40 * times)).astype(np.float32)
    scores[shown, np.arange(len(shown))] += 6
    for matrix, swapped in ((scores, False), (scores.T, True)):
        (found,) = stretches_of(matrix)
        rows, columns = (found.second, found.first) if swapped else (found.first, found.second)
        assert np.mean(shown[columns] == rows) > 0.9 and len(rows) >= 36


def places(kind: list[int], x: list[float], sequence: int = 0) -> Whereabouts:
    position = np.zeros((len(kind), 3))
    position[:, 0] = x
    codes = np.full(len(kind), sequence, np.int32)
    return Whereabouts(np.array(kind, np.int8), position, codes, np.arange(len(kind)))


def test_the_nearest_by_pose_is_of_the_same_kind_and_within_the_radius() -> None:
    queries = places([METRIC, METRIC, NO_POSE, GEOGRAPHIC, METRIC], [0.0, 4.9, 0.0, 0.0, 100.0])
    references = places([NO_POSE, METRIC, METRIC, METRIC], [0.0, 1.0, 5.0, 0.5])
    found = nearest_by_pose(queries, references, Neighborhood(5.0, 0))
    assert found is not None and found.tolist() == [3, 2, NONE, NONE, NONE]
    assert nearest_by_pose(queries, places([NO_POSE], [0.0]), Neighborhood(5.0, 0)) is None
    assert nearest_by_pose(places([GEOGRAPHIC], [0.0]), places([METRIC], [0.0]), Neighborhood(5.0, 0)) is None


def test_the_nearest_by_pose_is_on_the_same_storey() -> None:
    queries = replace(places([METRIC] * 2, [0.0, 0.0]), height=np.array([0.0, np.nan]))
    references = replace(places([METRIC] * 2, [0.0, 3.0]), height=np.array([4.0, 1.0]))
    found = nearest_by_pose(queries, references, Neighborhood(5.0, 0))
    assert found is not None and found.tolist() == [1, 0]


def test_counterparts_are_at_the_same_station_of_another_traverse() -> None:
    references = places([NO_POSE] * 4, [0.0] * 4, sequence=0)
    queries = places([NO_POSE] * 3, [0.0] * 3, sequence=1)
    assert counterparts(queries, references).tolist() == [NONE] * 3
    queries.track[:], queries.station[:] = [0, 1, 0], [2, 1, 9]
    assert counterparts(queries, references).tolist() == [2, NONE, NONE]
    assert counterparts(references, references).tolist() == [NONE] * 4
    nowhere = places([NO_POSE] * 2, [0.0] * 2, sequence=NO_SEQUENCE)
    assert counterparts(nowhere, nowhere).tolist() == [NONE] * 2
