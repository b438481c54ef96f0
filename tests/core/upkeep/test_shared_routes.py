"""Traverses that seem to follow one route."""

from __future__ import annotations

import numpy as np

from core.places import METRIC, NO_POSE, Whereabouts
from core.upkeep.hubness import Alias
from core.upkeep.shared_routes import SharedRoute, shared_routes

FRAMES = 12


def drives(kind: int = NO_POSE) -> Whereabouts:
    """Two traverses of twelve frames each."""
    sequence = np.repeat(np.array([0, 1], np.int32), FRAMES)
    ordinal = np.tile(np.arange(FRAMES), 2)
    return Whereabouts(np.full(2 * FRAMES, kind, np.int8), np.zeros((2 * FRAMES, 3)), sequence, ordinal)


def aliases(order: list[int]) -> list[Alias]:
    """Each frame of the second traverse looks like this one of the first."""
    return [Alias(FRAMES + frame, other, 0.5, 0.1) for frame, other in enumerate(order)]


def found(where: Whereabouts, some: list[Alias]) -> list[SharedRoute]:
    """The routes of traverses that were examined as a whole."""
    return shared_routes(where, some, np.arange(len(where)))


def test_frames_in_the_same_order_are_of_one_route() -> None:
    (route,) = found(drives(), aliases(list(range(FRAMES))))
    assert route.sequences == (0, 1) and len(route.aliases) == FRAMES
    astray = [*range(FRAMES - 1), 5]  # one of them looks like another
    assert len(found(drives(), aliases(astray))) == 1


def test_of_a_large_map_the_examined_frames_count() -> None:
    where = Whereabouts.along_sequence(np.arange(100))
    second = Whereabouts(where.kind, where.position, where.sequence + 1, where.ordinal)
    some = [Alias(100 + frame, frame, 0.5, 0.1) for frame in range(0, 100, 8)]
    places = np.array([alias.place for alias in some])
    assert len(shared_routes(Whereabouts.joined([where, second]), some, places)) == 1
    assert shared_routes(Whereabouts.joined([where, second]), some, np.arange(200)) == []


def test_look_alikes_in_no_order_are_none() -> None:
    shuffled = np.random.default_rng(1).permutation(FRAMES).tolist()
    assert found(drives(), aliases(shuffled)) == []
    assert found(drives(), aliases(list(range(FRAMES))[::-1])) == []
    assert found(drives(), aliases([3] * FRAMES)) == []


def test_a_few_frames_are_no_route() -> None:
    assert found(drives(), aliases(list(range(9)))) == []


def test_frames_that_poses_put_elsewhere_only_look_alike() -> None:
    assert found(drives(METRIC), aliases(list(range(FRAMES)))) == []
