"""Where places are after their counterparts were found, and which poses go over."""

from __future__ import annotations

import numpy as np
import pytest

from core.places import METRIC, NO_POSE, NO_SEQUENCE, Neighborhood, Whereabouts
from core.upkeep.correspondence import common_stations, handed_over, on_its_own

A, B, C = 1, 2, 3
FRAMES = 6


def traverses(*codes: int) -> Whereabouts:
    """Six places of each sequence, one after the other."""
    count = len(codes) * FRAMES
    return Whereabouts(
        np.full(count, NO_POSE, np.int8),
        np.zeros((count, 3)),
        np.repeat(np.array(codes, np.int32), FRAMES),
        np.tile(np.arange(FRAMES), len(codes)),
    )


def paired(first: int, second: int, shift: int = 0) -> list[list[int]]:
    """Frame i of one of the traverses with frame i + shift of another."""
    return [[FRAMES * first + i, FRAMES * second + i + shift] for i in range(FRAMES - shift)]


def joined(where: Whereabouts, pairs: list[list[int]]) -> Whereabouts:
    track, station = common_stations(where.track, where.station, np.array(pairs, np.int64).reshape(-1, 2))
    return Whereabouts(where.kind, where.position, where.sequence, where.ordinal, track=track, station=station)


@pytest.mark.parametrize("turned", [False, True])
def test_the_older_track_stays(turned: bool) -> None:
    pairs = [pair[::-1] if turned else pair for pair in paired(1, 0, shift=2)]
    found = joined(traverses(A, B), pairs)
    assert found.track.tolist() == [A] * FRAMES + [A] * 4 + [B] * 2
    assert found.station.tolist() == [0, 1, 2, 3, 4, 5, 2, 3, 4, 5, 4, 5]
    near = found.near(FRAMES, Neighborhood(5, 1))
    assert np.flatnonzero(near).tolist() == [1, 2, 3, FRAMES, FRAMES + 1]


ORDERS = ([(1, 0), (2, 1)], [(2, 1), (1, 0)], [(2, 0), (1, 2)], [(0, 2), (1, 0)])


@pytest.mark.parametrize("order", ORDERS)
def test_three_traverses_end_on_the_oldest_track_in_whichever_order_they_are_aligned(
    order: list[tuple[int, int]],
) -> None:
    where = traverses(A, B, C)
    for first, second in order:
        where = joined(where, paired(first, second))
    assert (where.track == A).all() and (where.station == where.ordinal).all()
    again = joined(where, paired(*order[-1]))
    assert (again.track == where.track).all() and (again.station == where.station).all()


def test_what_two_others_show_is_one_place() -> None:
    """C is aligned with A and with B, which were not aligned with each other, at different shifts."""
    found = joined(traverses(A, B, C), paired(2, 0, shift=1) + paired(2, 1))
    assert found.track.tolist() == [A] * FRAMES + [A] * 5 + [B] + [A] * 5 + [B]
    assert found.station.tolist() == [0, 1, 2, 3, 4, 5] + 2 * [1, 2, 3, 4, 5, 5]


def test_stations_of_one_track_are_not_joined_by_a_slower_traverse() -> None:
    """Each frame of A is seen twice by B, and every frame of B is paired with one of C."""
    slow = [[FRAMES + i, i // 2] for i in range(FRAMES)] + [[2 * FRAMES + i, FRAMES + i] for i in range(FRAMES)]
    found = joined(traverses(A, B, C), slow)
    assert found.station[:FRAMES].tolist() == [0, 1, 2, 3, 4, 5]
    assert found.station[FRAMES:].tolist() == 2 * [0, 0, 1, 1, 2, 2]


def test_released_places_return_to_their_own_tracks() -> None:
    where = joined(traverses(A, B), paired(1, 0))
    track, station = on_its_own(where, where.sequence == B)
    assert track.tolist() == [A] * FRAMES + [B] * FRAMES and station.tolist() == 2 * list(range(FRAMES))


def test_without_pairs_nothing_changes_and_places_without_a_sequence_have_none() -> None:
    assert (joined(traverses(A, B), []).track == traverses(A, B).sequence).all()
    with pytest.raises(ValueError, match="sequence"):
        joined(traverses(A, NO_SEQUENCE), paired(1, 0))


def test_poses_go_over_to_those_without_one() -> None:
    kind = np.array([METRIC, NO_POSE, NO_POSE, METRIC, NO_POSE, NO_POSE], np.int8)
    pairs = np.array([[2, 1], [1, 0], [4, 3], [1, 3], [0, 3], [5, 2]])
    assert sorted(handed_over(kind, pairs).tolist()) == [[1, 0], [2, 0], [4, 3], [5, 0]]
    assert handed_over(kind, pairs[:0]).shape == (0, 2)
