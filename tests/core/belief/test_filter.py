"""The hidden Markov model against sums over every path, written out."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.belief import Evidence, Odometry, PlaceGraph, Step, Stride, place_graph
from core.belief.filter import (
    JUMP,
    LEAVING,
    MANY,
    RETURNING,
    START_UNKNOWN,
    Belief,
    Smoother,
    observed,
    observed_by_speed,
    predicted,
    predicted_by_speed,
    reindexed,
    uninformed,
)
from core.belief.motion import Pending, Transition, transition
from core.belief.speeds import SPEEDS
from core.places import Neighborhood, Whereabouts
from tests.core.belief.maps import graph_of, posed, shows, walk

Matrix = NDArray[np.float64]


def matrix_of(graph: PlaceGraph, moved: Transition) -> Matrix:
    """T[i, j], the probability of j after i, column by column from the masses that one place alone gives."""
    rows = []
    for place in range(len(graph)):
        alone = np.zeros(len(graph), np.float32)
        alone[place] = 1
        after, spread, gone = moved.forward(alone, 0.0)
        rows.append(after + (spread + gone) / len(graph))
    return (1 - JUMP) * np.array(rows, np.float64) + JUMP / len(graph)


def likelihoods(graph: PlaceGraph, seen: Evidence) -> Matrix:
    values = np.zeros(len(graph))
    values[graph.places_at(seen.rows)] = seen.gains
    return np.exp(values)


evidences = st.lists(
    st.tuples(st.lists(st.integers(0, 4), max_size=3, unique=True), st.floats(0.1, 6), st.floats(0, 2)),
    min_size=1,
    max_size=4,
)


@pytest.mark.thorough
@settings(max_examples=40)
@given(evidences, st.sampled_from([0.0, 0.5, 1.0, 2.0]), st.booleans())
def test_it_is_the_sum_over_all_paths(told: list[tuple[list[int], float, float]], advance: float, back: bool) -> None:
    graph, stride = graph_of(walk(3, 2)), Stride(advance, back)
    frames = [shows(*rows, gain=gain, unknown=unknown) for rows, gain, unknown in told]
    moved = transition(graph, Step(), stride, Pending())
    matrix = (1 - JUMP) * moved.moves[0].matrix() + JUMP / len(graph)

    totals, unknown = np.zeros(len(graph)), START_UNKNOWN
    inside = 1.0  # of the frames so far, if the robot sees the map
    for path in itertools.product(range(len(graph)), repeat=len(frames)):
        chance = 1 / len(graph)
        for step, place in enumerate(path):
            chance *= likelihoods(graph, frames[step])[place]
            if step:
                chance *= matrix[path[step - 1], place]
        totals[path[-1]] += chance

    belief, before = uninformed(len(graph)), 1.0
    for step, frame in enumerate(frames):
        if step:
            unknown = (1 - RETURNING) * unknown + LEAVING * (1 - unknown)
        belief = observed(predicted(belief, moved) if step else belief, frame, graph)
        inside = sum(  # the likelihood of the frames up to this one, by another sum over all paths
            math.prod(
                [1 / len(graph)]
                + [likelihoods(graph, frames[i])[place] for i, place in enumerate(path)]
                + [matrix[a, b] for a, b in itertools.pairwise(path)]
            )
            for path in itertools.product(range(len(graph)), repeat=step + 1)
        )
        here, there = (1 - unknown) * inside / before, unknown * math.exp(frame.unknown)
        unknown, before = there / (here + there), inside
    np.testing.assert_allclose(belief.given, totals / totals.sum(), atol=2e-5)
    assert belief.unknown == pytest.approx(unknown, abs=1e-5)
    assert belief.places.sum() + belief.unknown == pytest.approx(1, abs=1e-5)


STEPS = [Step(), Step(frames=2), Step(reach=2.5), Step(odometry=Odometry(1.0)), Step(odometry=Odometry(1.0, 0.2, 1.5))]


@pytest.mark.parametrize("step", STEPS)
def test_smoothing_is_the_sum_over_all_paths(step: Step) -> None:
    graph = graph_of(posed([(0, 0), (1, 0), (2, 0), (2, 1)], [(0, 5), (1, 5)]))
    frames = [shows(0, 4, gain=2), shows(1, 5, gain=1), shows(2, gain=2), shows(3, gain=1)]
    moved = transition(graph, step, Stride(), Pending())
    matrix = matrix_of(graph, moved)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-5)

    smoother, belief = Smoother(2), uninformed(len(graph))
    for number, frame in enumerate(frames):
        belief = observed(predicted(belief, moved) if number else belief, frame, graph)
        smoother.append(belief, moved, frame)
        assert (smoother.smoothed(graph) is None) == (number < 2)
    totals = np.zeros(len(graph))
    for path in itertools.product(range(len(graph)), repeat=len(frames)):
        chance = math.prod(likelihoods(graph, frames[i])[place] for i, place in enumerate(path))
        totals[path[1]] += chance * math.prod(matrix[a, b] for a, b in itertools.pairwise(path))
    smoothed = smoother.smoothed(graph)
    assert smoothed is not None
    np.testing.assert_allclose(smoothed.given, totals / totals.sum(), atol=1e-4)


def test_what_all_hold_alike_is_moved_as_one() -> None:
    graph = graph_of(posed([(i, 0) for i in range(2 * MANY)]))
    exact = rounded = uninformed(len(graph))
    for number in range(20):
        for step in (Step(), Step(reach=1.2), Step(odometry=Odometry(1.0))):
            moved = transition(graph, step, Stride(), Pending())
            exact = observed(predicted(Belief(exact.given, exact.unknown), moved), shows(number + 3, 900), graph)
            rounded = observed(predicted(rounded, moved), shows(number + 3, 900), graph)
    np.testing.assert_allclose(rounded.given, exact.given, atol=0.02)
    assert rounded.unknown == pytest.approx(exact.unknown, abs=0.01)


def test_a_belief_survives_likelihoods_that_no_number_holds() -> None:
    graph, belief = graph_of(walk(50)), uninformed(50)
    moved = transition(graph, Step(), Stride(), Pending())
    for _ in range(300):
        belief = observed(predicted(belief, moved), shows(3, gain=80, unknown=40), graph)
        assert np.isfinite(belief.given).all() and belief.given.sum() == pytest.approx(1, abs=1e-3)
    assert belief.given.argmax() == 3
    for _ in range(300):
        belief = observed(predicted(belief, moved), shows(unknown=50), graph)
    assert belief.unknown == pytest.approx(1) and np.isfinite(belief.given).all()


def test_places_that_come_and_go_are_taken_over_by_row() -> None:
    where = walk(6)
    old = graph_of(where)
    new = _living(where, [0, 2, 3, 5])
    belief = Belief(np.array([0.1, 0.3, 0.2, 0.2, 0.1, 0.1], np.float32), 0.2)
    after = reindexed(belief, old, new)
    assert after.given == pytest.approx(np.array([0.1, 0.2, 0.2, 0.1]) / 0.6)
    assert after.unknown == pytest.approx(0.2 + 0.8 * 0.4), "what the dead held is believed to be out of the map"
    grown = reindexed(after, new, old)
    assert grown.given[[1, 4]] == pytest.approx(after.given.min() / (1 + 2 * after.given.min()), rel=1e-3)
    assert reindexed(belief, old, _living(where, [])).unknown == 1
    assert reindexed(uninformed(0), graph_of(walk()), old).unknown == START_UNKNOWN


def test_a_view_stays_where_the_robot_is_as_long_as_one_of_its_frames_is_left() -> None:
    where = Whereabouts.along_sequence([0, 1, *[2] * 10, 3])
    old, belief = _living(where, list(range(13))), Belief(np.array([0.05, 0.05, 0.85, 0.05], np.float32), 0.02)
    pruned = reindexed(belief, old, _living(where, [0, 1, 7, 12]))
    assert pruned.unknown == pytest.approx(0.02) and pruned.given == pytest.approx(belief.given)
    taken_out = reindexed(belief, old, _living(where, [0, 1, 12]))
    assert taken_out.unknown == pytest.approx(0.02 + 0.98 * 0.85)
    split = np.where(np.arange(13) >= 7, where.ordinal + 10, where.ordinal)
    apart = reindexed(belief, old, _living(Whereabouts.along_sequence(split), list(range(13))))
    assert apart.given == pytest.approx([0.05, 0.05, 0.425, 0.425, 0.05]), "each half has five of its frames"


def test_the_best_frame_of_a_view_tells_the_speed() -> None:
    graph = graph_of(Whereabouts.along_sequence([*range(10), 10, 10, 10, *range(11, 20)]))
    ahead = predicted_by_speed(observed(uninformed(len(graph)), shows(9), graph), graph)
    weights = np.linspace(0.1, 1, len(SPEEDS), dtype=np.float32)
    rows, gains = np.array([10, 11, 12]), np.array([6, 3, 0.1], np.float32)
    best = observed_by_speed(ahead, Evidence(rows[:1], gains[:1], 0.5), graph, weights)
    for order in ([0, 1, 2], [2, 0, 1]):
        told = observed_by_speed(ahead, Evidence(rows[order], gains[order], 0.5), graph, weights)
        assert told.given == pytest.approx(best.given)
        assert told.speeds.at(np.array([10])) == pytest.approx(best.speeds.at(np.array([10])))


def _living(where: Whereabouts, rows: list[int]) -> PlaceGraph:
    return place_graph(where, np.array(rows, np.int64), len(where), Neighborhood(1, 1))
