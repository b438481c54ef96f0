"""From place to place: along a sequence, within reach, by odometry."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from core.belief import Odometry, PlaceGraph, Step, Stride
from core.belief.motion import FARTHEST_STEPS, Pending, transition
from core.places import GEOGRAPHIC, Pose, Whereabouts
from tests.core.belief.maps import graph_of, posed, walk


def after(graph: PlaceGraph, place: int, step: Step, stride: Stride | None = None) -> tuple[np.ndarray, float, float]:
    """Where a robot is that was at ``place``, what of it may be anywhere, and what has left the map."""
    masses = np.zeros(len(graph), np.float32)
    masses[place] = 1
    return transition(graph, step, stride or Stride(), Pending()).forward(masses, 0.0)


@pytest.mark.parametrize("advance", [0.0, 0.1, 1.0, 3.0])
def test_the_usual_pace_is_the_likeliest(advance: float) -> None:
    moved, *_ = after(graph_of(walk(60)), 30, Step(), Stride(advance))
    assert moved.sum() == pytest.approx(1)
    assert int(moved.argmax()) == 30 + round(advance)
    assert moved[:29].sum() == 0, "a frame's slip back and no more"
    both, *_ = after(graph_of(walk(60)), 30, Step(), Stride(advance, backwards=True))
    np.testing.assert_allclose(both[30:], both[30::-1][: len(both[30:])], atol=1e-6)


def test_frames_that_did_not_arrive_are_walked_too() -> None:
    graph = graph_of(walk(60))
    assert int(after(graph, 10, Step(frames=5))[0].argmax()) == 15
    moved, spread, _ = after(graph, 10, Step(frames=FARTHEST_STEPS + 1))
    assert moved.sum() == 0 and spread == 1


def test_sequences_are_not_left() -> None:
    moved, *_ = after(graph_of(walk(5, 5)), 4, Step())
    assert moved[:5].sum() == pytest.approx(1) and moved[4] > 0.5


def test_within_reach() -> None:
    graph = graph_of(posed([(float(i), 0.0) for i in range(40)]))
    moved, *_ = after(graph, 20, Step(reach=2.0))
    np.testing.assert_allclose(moved[18:23], moved[20], rtol=1e-5)
    assert moved[[15, 25]].sum() == 0
    far, *_ = after(graph, 20, Step(reach=6.0))
    assert far[[16, 24]].min() > 0.02, "farther than the joined neighbours: in several steps"
    slow = transition(graph, Step(reach=0.2), Stride(), Pending())
    assert slow.forward(moved, 0.0)[0] == pytest.approx(moved), "too little to show"
    moved, spread, _ = after(graph, 20, Step(reach=1e4))
    assert moved.sum() == 0 and spread == 1


def test_small_motions_add_up() -> None:
    graph, pending = graph_of(posed([(2.0 * i, 0.0) for i in range(30)])), Pending()
    masses = np.zeros(30, np.float32)
    masses[10] = 1
    for _ in range(40):  # 8 m in steps of 0.2 m: four places on
        masses, *_ = transition(graph, Step(odometry=Odometry(0.2)), Stride(), pending).forward(masses, 0.0)
    assert abs(float(masses @ np.arange(30)) - 14) < 0.7


@pytest.mark.parametrize(
    ("motion", "expected"),
    [
        (Odometry(2.0), 12),
        (Odometry(-2.0), 8),
        (Odometry(0.0, 2.0), None),
        (Odometry(6.0, variance=0.1), 16),
        (Odometry(1.0).then(Odometry(1.0)), 12),
        (Odometry(1.0, 0, math.pi / 2).then(Odometry(1.0, 0, -math.pi / 2)).then(Odometry(0, -1)), 11),
    ],
)
def test_by_odometry(motion: Odometry, expected: int | None) -> None:
    graph = graph_of(posed([(float(i), 0.0) for i in range(40)]))
    moved, _, gone = after(graph, 10, Step(odometry=motion))
    if expected is None:
        assert gone + moved[[7, 8, 12, 13]].sum() > 0.9 or moved[10] > 0.1, "off to the side there is no place"
    else:
        assert int(moved.argmax()) == expected


def test_a_turn_tells_which_of_two_ways_was_taken() -> None:
    straight = [(float(i), 0.0) for i in range(20)]
    left = [(float(min(i, 9)), 30.0 + max(0.0, i - 9.0)) for i in range(20)]
    graph = graph_of(posed(straight, left))
    turned = Step(odometry=Odometry(1.0, 0.0, math.pi / 2))
    masses = np.zeros(40, np.float32)
    masses[[8, 28]] = 0.5
    moved, _, gone = transition(graph, turned, Stride(), Pending()).forward(masses, 0.0)
    assert moved[20:].sum() + gone > 5 * moved[:20].sum()


def test_places_without_a_pose_go_along_their_sequence() -> None:
    plain, metric = walk(10), posed([(float(i), 0.0) for i in range(10)])
    mixed = Whereabouts(
        np.concatenate([plain.kind, metric.kind]),
        np.concatenate([plain.position, metric.position]),
        np.repeat([0, 1], 10).astype(np.int32),
        np.tile(np.arange(10), 2),
    )
    graph = graph_of(mixed)
    assert int(after(graph, 3, Step(odometry=Odometry(4.0)))[0].argmax()) == 4
    assert int(after(graph, 13, Step(odometry=Odometry(4.0)))[0].argmax()) == 17


@pytest.mark.parametrize("longitude", [2.35, 180.0])
def test_on_the_earth_headings_count_from_north(longitude: float) -> None:
    east = 1 / (111_194.9 * math.cos(math.radians(48)))  # degrees of a metre
    poses = [Pose(latitude=48, longitude=(longitude + 180 + i * east) % 360 - 180, heading=90) for i in range(-10, 10)]
    where = Whereabouts(
        np.full(20, GEOGRAPHIC, np.int8),
        np.stack([pose.position() for pose in poses]),
        np.zeros(20, np.int32),
        np.arange(20),
        np.full(20, 90, np.float32),
    )
    graph = graph_of(where)
    assert graph.spacing == pytest.approx(1, abs=1e-3)
    assert int(after(graph, 10, Step(odometry=Odometry(2.0)))[0].argmax()) == 12
    assert int(after(graph, 10, Step(odometry=Odometry(-3.0)))[0].argmax()) == 7


def test_a_robot_goes_on_along_the_traverse_that_was_aligned() -> None:
    where = walk(6, 6)  # the second begins at the fourth place of the first
    shared = np.arange(12) >= 6
    where = replace(
        where,
        track=np.where(shared, 0, where.sequence).astype(np.int32),
        station=np.where(shared, where.ordinal + 3, where.ordinal),
    )
    graph = graph_of(where)
    masses = np.zeros(12, np.float32)
    masses[3] = 1
    for _ in range(4):
        moved = transition(graph, Step(), Stride(), Pending())
        expected = masses @ moved.moves[0].matrix() @ moved.moves[1].matrix()
        after, spread, gone = moved.forward(masses, 0.0)
        np.testing.assert_allclose(after, expected, atol=1e-5)
        assert (spread, gone) == (0, 0)
        back = moved.backward(masses, 0.0)
        np.testing.assert_allclose(back, moved.moves[0].matrix() @ moved.moves[1].matrix() @ masses, atol=1e-5)
        masses = after
    assert masses[9:].sum() > 0.05, "where the first has no place any more"
    assert graph_of(walk(6, 6)).stations.size == 0
