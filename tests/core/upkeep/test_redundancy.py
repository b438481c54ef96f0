"""What goes has a stand-in, always; what is measured is what a search would find."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.places import GEOGRAPHIC, METRIC, NO_POSE, Neighborhood, Whereabouts
from core.upkeep.hubness import NONE
from core.upkeep.redundancy import (
    FEWEST_FRAMES_OF_STOP,
    MOST_NEIGHBOURS,
    RemovalTrial,
    Thinning,
    best_thinning,
    first_looks,
    neighbour_pairs,
    steps,
    thinned,
)


def where(kinds: list[int], x: list[float], sequences: list[int] | None = None) -> Whereabouts:
    position = np.zeros((len(x), 3))
    position[:, 0] = x
    codes = np.array(sequences if sequences is not None else [0] * len(x), np.int32)
    ordinal = np.array([int((codes[:i] == code).sum()) for i, code in enumerate(codes)], np.int64)
    return Whereabouts(np.array(kinds, np.int8), position, codes, ordinal)


@given(
    st.lists(
        st.tuples(
            st.sampled_from([NO_POSE, METRIC, GEOGRAPHIC]),
            st.integers(0, 40),
            st.integers(-1, 1),
            st.none() | st.tuples(st.integers(0, 2), st.integers(0, 5)),
        ),
        max_size=MOST_NEIGHBOURS // 2,
    ),
    st.integers(0, 10),
    st.integers(0, 4),
)
def test_pairs_are_those_that_the_verdict_takes_for_one_place(
    places: list[tuple[int, int, int, tuple[int, int] | None]], radius: int, frames: int
) -> None:
    there = where([p[0] for p in places], [float(p[1]) for p in places], [p[2] for p in places])
    for row, place in enumerate(places):
        if place[3] is not None:
            there.track[row], there.station[row] = place[3]
    neighborhood = Neighborhood(float(radius), frames)
    expected = {
        (i, j) for i in range(len(places)) for j in np.flatnonzero(there.near(i, neighborhood)).tolist() if i < j
    }
    assert {(a, b) for a, b in neighbour_pairs(there, neighborhood).tolist()} == expected


def test_where_a_robot_stood_still_pairs_are_bounded() -> None:
    there = where([METRIC] * 500, [0.0] * 500)
    assert len(neighbour_pairs(there, Neighborhood(5.0, 3))) <= 500 * MOST_NEIGHBOURS


def test_the_first_frame_of_a_stop_stands_for_the_others() -> None:
    frames = [0, 1, *[2] * FEWEST_FRAMES_OF_STOP, 3, *[4] * (FEWEST_FRAMES_OF_STOP - 1)]
    there = Whereabouts.along_sequence(frames)
    expected = [0, 1, *[2] * FEWEST_FRAMES_OF_STOP, *range(2 + FEWEST_FRAMES_OF_STOP, len(frames))]
    assert first_looks(there, Neighborhood(5.0, 3)).tolist() == expected, "fewer frames are no stop"
    there.kind[:] = METRIC
    there.position[5, 0] = 1000.0
    expected[5] = 5
    assert first_looks(there, Neighborhood(5.0, 3)).tolist() == expected, "poses say that it is elsewhere"


Graph = tuple[int, NDArray[np.int64], NDArray[np.float32], float]


@st.composite
def graphs(draw: st.DrawFn) -> Graph:
    places = draw(st.integers(1, 20))
    every = [(a, b) for a in range(places) for b in range(a + 1, places)]
    chosen = draw(st.lists(st.sampled_from(every), unique=True, max_size=60)) if every else []
    scores = draw(st.lists(st.integers(0, 10), min_size=len(chosen), max_size=len(chosen)))
    pairs = np.array(chosen, np.int64).reshape(-1, 2)
    return places, pairs, np.array(scores, np.float32) / np.float32(10), draw(st.integers(0, 11)) / 10


@pytest.mark.thorough
@given(graphs())
@settings(max_examples=300)
def test_whatever_goes_has_a_stand_in_that_stays(graph: Graph) -> None:
    places, pairs, similarity, least = graph
    retained = thinned(places, pairs, similarity, least)
    alike = {(int(a), int(b)) for (a, b), s in zip(pairs, similarity, strict=True) if s >= np.float32(least)}
    for place in np.flatnonzero(~retained).tolist():
        assert any(retained[other] for pair in alike if place in pair for other in pair if other != place)


@pytest.mark.thorough
@given(graphs())
def test_nothing_is_left_that_could_go(graph: Graph) -> None:
    """Greedy, but to the end: no retained place with a stand-in could go without leaving another one alone."""
    places, pairs, similarity, least = graph
    retained = thinned(places, pairs, similarity, least)
    near: list[set[int]] = [set() for _ in range(places)]
    for (a, b), score in zip(pairs.tolist(), similarity.tolist(), strict=True):
        if score >= least:
            near[a].add(b)
            near[b].add(a)

    def count(place: int) -> int:
        return sum(bool(retained[other]) for other in near[place])

    for place in np.flatnonzero(retained).tolist():
        alone = any(not retained[other] and count(other) == 1 for other in near[place])
        assert count(place) == 0 or alone


def test_a_dense_line_is_thinned_and_a_sparse_one_is_not() -> None:
    dense = where([METRIC] * 30, [0.1 * n for n in range(30)])
    pairs = neighbour_pairs(dense, Neighborhood(0.15, 0))
    assert len(pairs) == 29
    retained = thinned(30, pairs, np.full(29, 0.9, np.float32), 0.5)
    assert 10 <= retained.sum() <= 20
    assert thinned(30, pairs, np.full(29, 0.4, np.float32), 0.5).all()


def trial(positions: list[list[int]], right: list[list[bool]], candidates: int = 0, **more: object) -> RemovalTrial:
    shape = np.array(positions).shape
    scores = more.get("scores", [list(np.linspace(0.9, 0.1, shape[1]))] * shape[0])
    gains = more.get("gains", np.zeros(shape))
    return RemovalTrial(
        np.array(positions, np.int64),
        np.array(scores, np.float32),
        np.array(gains, np.float32),
        np.array(right, np.bool_),
        candidates,
    )


def test_the_best_of_those_retained_counts() -> None:
    held = trial([[0, 1, 2], [2, 1, NONE]], [[True, False, False], [False, True, False]])
    assert held.found(np.array([True, True, True])).tolist() == [True, False]
    assert held.found(np.array([False, True, True])).tolist() == [False, False]
    assert held.found(np.array([True, True, False])).tolist() == [True, True]
    assert held.found(np.array([False, False, False])).tolist() == [False, False], "nothing found is not right"


def test_the_second_stage_examines_the_first_of_those_retained() -> None:
    gains = [[0.0, 0.5, 0.9]]
    held = trial([[0, 1, 2]], [[False, True, False]], candidates=2, scores=[[0.5, 0.4, 0.3]], gains=gains)
    assert held.found(np.ones(3, np.bool_)).tolist() == [True], "place 2 is not examined, for two come first"
    assert held.found(np.array([False, True, True])).tolist() == [False], "now it is, and gains more"


def test_the_choice_stops_at_the_first_that_costs_too_much() -> None:
    before = np.ones(10, np.bool_)

    def losing(count: int, least: float) -> Thinning:
        return Thinning(least, np.ones(4, np.bool_), before, np.arange(10) >= count)

    tried = [losing(0, 0.9), losing(1, 0.8), losing(3, 0.7), losing(0, 0.6)]
    assert best_thinning(tried, 0.1) is tried[1]
    assert best_thinning(tried, 0.0) is tried[0]
    assert best_thinning(tried[1:], 0.05) is None
    assert tried[1].loss == pytest.approx(0.1)


def test_steps_go_from_gentle_to_bold() -> None:
    found = steps(np.linspace(0, 1, 101, dtype=np.float32), 4)
    assert found == pytest.approx([0.75, 0.5, 0.25, 0.0])
    assert steps(np.empty(0, np.float32), 4) == []
