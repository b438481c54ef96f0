"""Which places are the same: by poses, by sequences, and by the tracks on which alignment put them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.places import (
    EARTH_RADIUS,
    GEOGRAPHIC,
    METRIC,
    NO_LEVEL,
    NO_POSE,
    NO_SEQUENCE,
    Neighborhood,
    PlaceFields,
    Whereabouts,
)

NEARBY = Neighborhood(5.0, 1)
# Traverse 0 has four frames.  Of traverse 1 the second and third show what stations 1 and 2 of traverse 0 show, and a
# frame without a sequence shows station 2.
ORDINALS = [0, 1, 2, 3, 0, 1, 2, 9]
SEQUENCES = [0, 0, 0, 0, 1, 1, 1, NO_SEQUENCE]
TRACKS = [0, 0, 0, 0, 1, 0, 0, 0]
STATIONS = [0, 1, 2, 3, 0, 1, 2, 2]


def aligned() -> Whereabouts:
    count = len(ORDINALS)
    return Whereabouts(
        np.zeros(count, np.int8),
        np.zeros((count, 3)),
        np.array(SEQUENCES, np.int32),
        np.array(ORDINALS, np.int64),
        track=np.array(TRACKS, np.int32),
        station=np.array(STATIONS, np.int64),
    )


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (0, [0, 1, 5]),
        (2, [1, 2, 3, 5, 6, 7]),
        (4, [4, 5]),  # has no counterpart: only its own sequence
        (5, [0, 1, 2, 4, 5, 6, 7]),
        (7, [1, 2, 3, 5, 6, 7]),
    ],
)
def test_places_at_one_station_are_the_same(row: int, expected: list[int]) -> None:
    assert np.flatnonzero(aligned().near(row, NEARBY)).tolist() == expected


def storeys(kind: int, levels: list[int], heights: list[float]) -> Whereabouts:
    """Places one above the other, each of a traverse of its own."""
    count = len(levels)
    position = np.array([[EARTH_RADIUS, 0, 0] if kind == GEOGRAPHIC else [0, 0, z] for z in np.nan_to_num(heights)])
    return Whereabouts(
        np.full(count, kind, np.int8),
        position,
        np.arange(count, dtype=np.int32),
        np.zeros(count, np.int64),
        level=np.array(levels, np.int32),
        height=np.array(heights),
    )


@pytest.mark.parametrize("kind", [METRIC, GEOGRAPHIC])
def test_places_on_different_storeys_are_never_the_same(kind: int) -> None:
    no, nan = NO_LEVEL, np.nan
    where = storeys(kind, [no, no, no, no, 1, 1, 2], [0.0, 1.5, 4.0, nan, 0.0, 4.0, 0.0])
    near = [np.flatnonzero(where.near(row, NEARBY)).tolist() for row in range(7)]
    assert near[0] == [0, 1, 3, 4, 6], "without a level the height counts, where both are known"
    assert near[3] == [0, 1, 2, 3, 4, 5, 6]
    assert near[4] == [0, 1, 3, 4, 5], "two levels decide, whatever the heights"
    assert near[6] == [0, 1, 3, 6]


def test_a_radius_is_one_along_the_ground_and_a_storey_stays_as_high() -> None:
    where = storeys(METRIC, [NO_LEVEL] * 3, [0.0, 1.4, 2.0])
    where.position[:, 0] = [0, 4.9, 0]
    assert np.flatnonzero(where.near(0, NEARBY)).tolist() == [0, 1]
    assert np.flatnonzero(where.near(0, NEARBY.times(3))).tolist() == [0, 1]


def test_one_sequence_on_two_levels_is_two_places() -> None:
    where = replace(Whereabouts.along_sequence([0, 0, 1]), level=np.array([1, 2, 1], np.int32))
    assert np.flatnonzero(where.near(0, NEARBY)).tolist() == [0, 2]
    assert where.others(0, NEARBY).tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("metadata", "level"),
    [
        ({"floor": 2}, "2"), ({"level": "EG", "floor": 2}, "EG"), ({"story": -1.0}, "-1"), ({"storey": "e\u0301"}, "é"),
        ({"floor": True}, None), ({"floor": 1.5}, None), ({"floor": "x" * 33}, None), ({"floor": ""}, None), ({}, None),
    ],
)  # fmt: skip
def test_a_level_is_read_from_metadata(metadata: dict[str, object], level: str | None) -> None:
    assert PlaceFields(metadata=metadata).level == level
    assert PlaceFields(level="roof", metadata=metadata).level == "roof"


def test_poses_decide_before_tracks_do() -> None:
    where = aligned()
    where.kind[[1, 5]] = METRIC
    where.position[5, 0] = 50.0
    assert not where.near(1, NEARBY)[5]


def test_tracks_are_the_places_own_unless_alignment_knows_others() -> None:
    where = Whereabouts.along_sequence([3, 1])
    assert (where.track.tolist(), where.station.tolist()) == ([0, 0], [3, 1])
    where.track[0] = 7
    assert where.sequence.tolist() == [0, 0]


def test_parts_are_taken_and_joined_with_all_columns() -> None:
    where = aligned()
    again = Whereabouts.joined([where.take([0, 1, 2]), where.take(np.arange(len(where)) >= 3)])
    for name, column in vars(where).items():
        np.testing.assert_array_equal(getattr(again, name), column)
        assert getattr(again, name).dtype == column.dtype
    assert len(Whereabouts.joined([])) == 0


def test_of_other_places_at_one_station_only_the_first_counts() -> None:
    """A ranking of three traverses, of which the last two are aligned; one place belongs to no sequence."""
    sequence = np.array([0, 1, 2, 2, 1, 1, NO_SEQUENCE, NO_SEQUENCE], np.int32)
    ordinal = np.array([9, 5, 3, 0, 9, 6, 0, 1])
    track = np.where(sequence == 2, 1, sequence).astype(np.int32)
    station = np.array([9, 5, 5, 9, 9, 6, 0, 1])
    count = len(sequence)
    columns = (np.full(count, NO_POSE, np.int8), np.zeros((count, 3)), sequence, ordinal)
    where = Whereabouts(*columns, track=track, station=station)
    assert np.flatnonzero(where.others(0, Neighborhood(1, 0))).tolist() == [1, 3, 5, 6, 7]
    assert np.flatnonzero(where.others(1, Neighborhood(1, 1))).tolist() == [0, 3, 6, 7]
    alone = Whereabouts(*columns)
    np.testing.assert_array_equal(alone.others(1, Neighborhood(1, 1)), ~alone.near(1, Neighborhood(1, 1)))


def stood() -> Whereabouts:
    """A walk of six views, in the third and the fifth of which the robot stood."""
    return Whereabouts.along_sequence([0, 1, 2, 2, 2, 3, 4, 4, 4, 4, 5])


def test_frames_of_one_view_are_one_place_and_count_once_elsewhere() -> None:
    where = stood()
    assert np.flatnonzero(where.near(3, NEARBY)).tolist() == [1, 2, 3, 4, 5]
    assert np.flatnonzero(where.others(3, NEARBY)).tolist() == [0, 6, 10]
    assert np.flatnonzero(where.repeats(np.arange(len(where)))).tolist() == [3, 4, 7, 8, 9]
    assert where.repeats(np.array([9, 7, 3, 2])).tolist() == [False, True, False, True]


def test_places_without_a_sequence_are_one_place_only_where_they_share_a_position() -> None:
    where = stood()
    where.sequence[:] = where.track[:] = NO_SEQUENCE
    where.ordinal[:] = where.station[:] = np.arange(len(where))
    assert not where.repeats(np.arange(len(where))).any()
    assert where.others(3, NEARBY).sum() == len(where) - 1
    where.ordinal[4] = where.station[4] = 3  # a look of the place at 3
    assert np.flatnonzero(where.near(3, NEARBY)).tolist() == [3, 4]
    assert np.flatnonzero(where.repeats(np.arange(len(where)))).tolist() == [4]
    assert where.others(3, NEARBY).sum() == len(where) - 2
    assert np.flatnonzero(where.of_views(np.array([4]))).tolist() == [3, 4]


@pytest.mark.parametrize(("metres", "same"), [(4.0, True), (14.0, True), (16.0, False)])
def test_coarse_poses_of_one_view_may_be_a_little_farther_apart(metres: float, same: bool) -> None:
    where = stood()
    where.kind[:] = METRIC
    where.position[4, 0] = metres
    assert where.near(3, NEARBY)[4] == same
    assert where.near(5, NEARBY)[4] == (metres <= 5)
