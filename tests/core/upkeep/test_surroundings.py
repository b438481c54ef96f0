"""The frames of a map around a pose."""

from __future__ import annotations

import math

import numpy as np
import pytest

from core.places import EARTH_RADIUS, GEOGRAPHIC, METRIC, NO_POSE, NO_SEQUENCE, Pose, Whereabouts
from core.upkeep.surroundings import surroundings


def along(x: list[float], headings: list[float] | None = None, z: float = 0.0) -> Whereabouts:
    """Frames of one traverse on the x axis."""
    count = len(x)
    return Whereabouts(
        np.full(count, METRIC, np.int8),
        np.array([[one, 0.0, z] for one in x]).reshape(-1, 3),
        np.zeros(count, np.int32),
        np.arange(count),
        np.array([math.nan] * count if headings is None else headings, np.float32),
        height=np.full(count, z),
    )


@pytest.mark.parametrize(
    ("pose", "state"),
    [
        (Pose(x=1, y=1), "covered"),
        (Pose(x=0, y=0, heading=44), "covered"),
        (Pose(x=0, y=0, heading=316), "covered"),
        (Pose(x=0, y=0, heading=46), "other-direction"),
        (Pose(x=4, y=0, heading=200), "covered"),  # its frame has no heading
        (Pose(x=10, y=1.5), "gap"),
        (Pose(x=10, y=2.5), "outside"),
        (Pose(x=40, y=0), "outside"),  # on the line of two frames that are too far apart
        (Pose(x=-3, y=0), "outside"),
    ],
)
def test_whether_a_pose_is_in_a_map(pose: Pose, state: str) -> None:
    where = along([0, 2, 4, 16, 80], [0, 0, math.nan, 0, 0])
    assert surroundings(where, pose, radius=2.0).state == state


def test_distances_turns_and_directions() -> None:
    found = surroundings(along([0, 1, 2, 30], [350, 10, 90, 180]), Pose(x=0, y=0, heading=0), radius=2.0)
    assert found.distance.tolist() == [0, 1, 2, 30] and found.order.tolist() == [0, 1, 2, 3] and found.near == 3
    assert found.turn.tolist() == pytest.approx([10, 10, 90, 180])
    assert found.directions.tolist() == [2, 0, 1, 0, 0, 0, 0, 0]


def test_a_gap_names_the_frames_and_how_far_they_are() -> None:
    found = surroundings(along([0, 2, 4, 16]), Pose(x=9, y=-1), radius=2.0)
    assert found.between is not None
    assert (found.between.before, found.between.after) == (2, 3)
    assert (found.between.metres, found.between.aside) == (12, 1)


def test_frames_without_a_sequence_have_nothing_between_them() -> None:
    where = along([0, 10])
    where.sequence[:] = NO_SEQUENCE
    assert surroundings(where, Pose(x=5, y=0), radius=2.0).state == "outside"


def test_a_height_counts_only_if_it_is_given() -> None:
    where = along([0], z=4.0)
    assert surroundings(where, Pose(x=0, y=0), radius=2.0).state == "covered"
    assert surroundings(where, Pose(x=0, y=0, z=3.5), radius=2.0).state == "covered"
    assert surroundings(where, Pose(x=0, y=0, z=0.0), radius=2.0).state == "outside"


def test_poses_of_another_kind_and_none_are_nowhere() -> None:
    where = along([0, 1])
    where.kind[:] = NO_POSE, GEOGRAPHIC
    found = surroundings(where, Pose(x=0, y=0), radius=2.0)
    assert found.state == "outside" and found.order.tolist() == [] and not np.isfinite(found.distance).any()
    assert surroundings(Whereabouts.along_sequence([]), Pose(x=0, y=0), 2.0).state == "outside"


def test_the_antimeridian_is_no_border() -> None:
    east, west = Pose(latitude=10, longitude=179.99999), Pose(latitude=10, longitude=-179.99999)
    where = Whereabouts(
        np.array([GEOGRAPHIC], np.int8), east.position()[np.newaxis], np.zeros(1, np.int32), np.zeros(1, np.int64)
    )
    found = surroundings(where, west, radius=5.0)
    apart = math.radians(2e-5) * EARTH_RADIUS * math.cos(math.radians(10))
    assert found.state == "covered" and found.distance[0] == pytest.approx(apart, rel=1e-3)
