"""Which places follow one another, lie near one another, and are the same place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.belief import place_graph
from core.belief.graph import ALONG
from core.places import METRIC, NO_LEVEL, NO_POSE, Neighborhood, Whereabouts
from tests.core.belief.maps import graph_of, posed, walk


@pytest.mark.parametrize("aligned", [False, True])
@pytest.mark.parametrize("frames", [0, 2, 7])
def test_the_same_place_is_what_the_verdict_takes_for_it(frames: int, aligned: bool) -> None:
    random = np.random.default_rng(frames)
    kinds = np.where(random.random(80) < 0.6, METRIC, NO_POSE).astype(np.int8)
    position = np.where(kinds[:, None] == METRIC, random.uniform(0, 30, (80, 3)) * (1, 1, 0), 0.0)
    ordinal = np.sort(random.choice(400, 80, replace=False))
    where = Whereabouts(kinds, position, random.integers(-1, 3, 80).astype(np.int32), ordinal)
    if aligned:  # half of the places of sequence 1 are at stations of sequence 0
        counterparts = (where.sequence == 1) & (random.random(80) < 0.5)
        track = np.where(counterparts, 0, where.sequence).astype(np.int32)
        station = np.where(counterparts, random.integers(0, 400, 80), ordinal)
        where = replace(where, track=track, station=station)
    levels = random.choice([NO_LEVEL, 1, 2], 80, p=[0.5, 0.3, 0.2]).astype(np.int32)
    heights = np.where(random.random(80) < 0.3, np.nan, random.choice([0.0, 1.0, 4.0], 80))
    where = replace(where, level=levels, height=heights)
    neighborhood = Neighborhood(3.0, frames)
    graph = graph_of(where, neighborhood)
    for place in range(80):
        expected = np.flatnonzero(graph.whereabouts.near(place, neighborhood))
        np.testing.assert_array_equal(graph.same_place(place), expected)


@pytest.mark.thorough
def test_only_what_lives_is_in_it_in_the_order_of_the_sequences() -> None:
    where = walk(4, 4)
    graph = place_graph(where, np.array([6, 1, 3, 4]), 8, Neighborhood(1, 1))
    assert graph.rows.tolist() == [1, 3, 4, 6]
    assert graph.index.tolist() == [-1, 0, -1, 1, 2, -1, 3, -1]
    assert graph.first.tolist() == [0, 0, 2, 2] and graph.last.tolist() == [2, 2, 4, 4]
    assert graph.places_at(np.array([3, 0, 99, -1, 6])).tolist() == [1, -1, -1, -1, 3]
    assert graph.same_place(0).tolist() == [0], "two frames apart by their ordinals, though next to each other here"


def test_a_place_is_joined_to_its_neighbours_and_to_what_comes_next() -> None:
    crowd = [(0.01 * i, 0.0) for i in range(60)]
    onward = [(10.0 * i, 100.0) for i in range(10)]
    graph = graph_of(posed(crowd, onward))
    for place in range(70):
        joined = graph.targets[graph.starts[place] : graph.starts[place + 1]].tolist()
        assert joined[0] == place and len(set(joined)) == len(joined)
        beside = range(max(graph.first[place], place - ALONG), min(graph.last[place], place + ALONG + 1))
        assert set(beside) <= set(joined)
    assert graph.heading[65] == pytest.approx(0)


@pytest.mark.parametrize("known", ["levels", "heights", "both"])
def test_only_a_traverse_leads_to_another_storey(known: str) -> None:
    corridor = [(float(x), 0.0) for x in range(20)]
    where = posed(corridor, corridor, [(0.0, 0.5)] * 2)  # the third goes up in a lift
    storey = np.repeat([0, 1, 0, 1], [20, 20, 1, 1])
    if known != "heights":
        where = replace(where, level=storey.astype(np.int32))
    if known != "levels":
        where.position[:, 2] = 4.0 * storey
        where = replace(where, height=4.0 * storey)
    graph = graph_of(where, Neighborhood(5.0, 1))
    sources = np.repeat(np.arange(42), np.diff(graph.starts))
    across = storey[sources] != storey[graph.targets]
    assert set(zip(sources[across].tolist(), graph.targets[across].tolist(), strict=True)) == {(40, 41), (41, 40)}
    inside = graph.targets[graph.starts[5] : graph.starts[6]]
    assert {3, 4, 6, 7} <= set(inside.tolist()), "those of its own storey are joined as before"


def test_a_map_of_none_and_of_one() -> None:
    assert len(graph_of(walk())) == 0
    one = graph_of(posed([(1.0, 2.0)]))
    assert one.same_place(0).tolist() == [0] and one.spacing == 0
    assert graph_of(walk(1)).same_place(0).tolist() == [0]
