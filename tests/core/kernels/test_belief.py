"""The compiled motions of a belief are products with the matrices that ``core.belief.motion`` writes out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from core.belief import Odometry, PlaceGraph, Step, Stride
from core.belief.motion import Pending, transition
from core.places import GEOGRAPHIC, Pose, Whereabouts
from tests.core.belief.maps import graph_of, posed, walk


def wandering(seed: int) -> PlaceGraph:
    """Two walks in metres that cross, with headings here and there, and a sequence without poses."""
    random = np.random.default_rng(seed)
    walks = posed(*(np.cumsum(random.normal(0.5, 0.7, (15, 2)), axis=0).tolist() for _ in range(2)))
    plain = walk(8)
    heading = np.where(random.random(38) < 0.5, random.random(38) * 360, np.nan).astype(np.float32)
    return graph_of(
        Whereabouts(
            np.concatenate([walks.kind, plain.kind]),
            np.concatenate([walks.position, plain.position]),
            np.concatenate([walks.sequence, plain.sequence + 2]).astype(np.int32),
            np.concatenate([walks.ordinal, plain.ordinal]),
            heading,
        )
    )


def round_the_earth() -> PlaceGraph:
    """A walk across the meridian of ±180 degrees."""
    poses = [Pose(latitude=60 + i * 1e-6, longitude=(360 + i * 2e-5) % 360 - 180) for i in range(-10, 10)]
    positions = np.stack([pose.position() for pose in poses])
    return graph_of(Whereabouts(np.full(20, GEOGRAPHIC, np.int8), positions, np.zeros(20, np.int32), np.arange(20)))


STEPS = {
    "along": (Step(), Stride()),
    "backwards": (Step(), Stride(0.4, backwards=True)),
    "fast": (Step(), Stride(6.0)),
    "reach": (Step(reach=1.5), Stride()),
    "odometry": (Step(odometry=Odometry(0.8, 0.3, 0.4, 0.1, 0.02)), Stride()),
    "turn": (Step(odometry=Odometry(0.0, 0.0, math.pi)), Stride()),
}


@pytest.mark.parametrize("graph", [wandering(0), wandering(1), round_the_earth()], ids=["walks", "others", "earth"])
@pytest.mark.parametrize("step", STEPS)
def test_moves_are_products_with_their_matrices(graph: PlaceGraph, step: str) -> None:
    moves = transition(graph, *STEPS[step], Pending()).moves
    assert moves
    masses = np.random.default_rng(2).random(len(graph)).astype(np.float32)
    masses /= masses.sum()
    for move in moves:
        matrix = move.matrix()
        leaving = 1 - matrix.sum(axis=1)
        assert (matrix >= 0).all() and (leaving > -1e-9).all()
        moved = np.zeros_like(masses)
        still, left = move(masses, 0.0, False, 0.0, moved)
        np.testing.assert_allclose(moved, masses @ matrix, rtol=1e-4, atol=1e-7)
        assert still == 0 and left == pytest.approx(float(masses @ leaving), abs=1e-6)
        back = np.zeros_like(masses)
        move(masses, 0.0, True, 0.3, back)
        np.testing.assert_allclose(back, matrix @ masses + 0.3 * leaving, rtol=1e-4, atol=1e-7)


def test_small_masses_are_not_moved_but_counted() -> None:
    graph = graph_of(walk(6))
    (move,) = transition(graph, Step(), Stride(), Pending()).moves
    masses, moved = np.array([0.1, 0.0, 0.4, 0.1, 0.4, 0.0], np.float32), np.zeros(6, np.float32)
    still, _ = move(masses, 0.15, False, 0.0, moved)
    assert still == pytest.approx(0.2)
    np.testing.assert_allclose(moved, np.where(masses > 0.15, masses, 0) @ move.matrix(), rtol=1e-5)
