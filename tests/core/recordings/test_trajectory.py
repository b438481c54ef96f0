"""Trajectories: interpolation, and the files of TUM and KITTI."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from core.errors import InvalidTrajectory
from core.recordings.trajectory import Trajectory
from core.recordings.trajectory_files import read_trajectory

SECOND = 1_000_000_000
metres = st.floats(-1e6, 1e6)
yaws = st.floats(0, 360, exclude_max=True)
shares = st.floats(0, 1)


def turn(yaw: float) -> list[float]:
    return [0.0, 0.0, math.sin(math.radians(yaw) / 2), math.cos(math.radians(yaw) / 2)]


def path_of(*samples: tuple[float, float, float, float]) -> Trajectory:
    """Samples: seconds, x, y, yaw in degrees."""
    return Trajectory.of_samples(
        [round(seconds * SECOND) for seconds, *_ in samples],
        [[x, y, 0] for _, x, y, _ in samples],
        [turn(yaw) for *_, yaw in samples],
    )


def apart(one: float, other: float) -> float:
    """Degrees between two headings."""
    return abs((one - other + 180) % 360 - 180)


@given(metres, metres, metres, metres, yaws, yaws, shares)
def test_between_two_samples_lies_the_line_and_the_short_arc(
    x0: float, y0: float, x1: float, y1: float, yaw0: float, yaw1: float, share: float
) -> None:
    begin = 1_700_000_000 * SECOND
    path = Trajectory.of_samples([begin, begin + SECOND], [[x0, y0, 0], [x1, y1, 0]], [turn(yaw0), turn(yaw1)])
    (pose,) = path.at([begin + round(share * SECOND)], 1)
    assert pose is not None and pose.x is not None and pose.y is not None and pose.heading is not None
    assert pose.x == pytest.approx(x0 + share * (x1 - x0), abs=1e-2 + 1e-6 * max(abs(x0), abs(x1)))
    assert pose.y == pytest.approx(y0 + share * (y1 - y0), abs=1e-2 + 1e-6 * max(abs(y0), abs(y1)))
    arc = apart(yaw0, yaw1)
    if arc < 179.9:  # at half a turn both ways are as short
        assert apart(pose.heading, yaw0) == pytest.approx(share * arc, abs=1e-3)
        assert apart(pose.heading, yaw1) == pytest.approx((1 - share) * arc, abs=1e-3)


@given(st.lists(st.tuples(st.integers(0, 50), metres, yaws), min_size=1, max_size=8), st.permutations(range(8)))
def test_samples_are_met_exactly_in_whatever_order_they_are_given(
    samples: list[tuple[int, float, float]], order: list[int]
) -> None:
    shuffled = [samples[index] for index in order if index < len(samples)]
    path = path_of(*((seconds, x, -x, yaw) for seconds, x, yaw in shuffled))
    first: dict[int, tuple[float, float]] = {}
    for seconds, x, yaw in shuffled:
        first.setdefault(seconds, (x, yaw))
    for seconds, (x, yaw) in first.items():
        (pose,) = path.at([seconds * SECOND], 0)
        assert pose is not None and (pose.x, pose.y) == (x, -x)
        assert apart(pose.heading or 0.0, yaw) < 1e-6


@given(st.lists(st.integers(0, 40), min_size=2, max_size=10, unique=True), st.floats(0, 45), st.integers(0, 20))
def test_no_pose_is_told_in_a_gap_or_beyond_the_ends(times: list[int], asked: float, largest: int) -> None:
    path = path_of(*((seconds, seconds, 0, 0) for seconds in times))
    (pose,) = path.at([round(asked * SECOND)], largest)
    before = [one for one in times if one * SECOND <= round(asked * SECOND)]
    after = [one for one in times if one * SECOND >= round(asked * SECOND)]
    known = bool(before and after) and (max(before) == min(after) or min(after) - max(before) <= largest)
    assert (pose is not None) == known
    if pose is not None:
        assert pose.x == pytest.approx(asked, abs=1e-6)


def test_nanoseconds_of_today_are_told_apart() -> None:
    start = 1_700_000_000 * SECOND
    path = Trajectory.of_samples([start, start + 100], [[0, 0, 0], [100, 0, 0]], [turn(0), turn(0)])
    assert [pose.x for pose in path.at([start + 1, start + 99], 1) if pose is not None] == [1, 99]


def test_what_points_up_or_has_no_orientation_has_no_heading() -> None:
    up = Rotation.from_euler("y", -90, degrees=True).as_quat()
    path = Trajectory.of_samples([0, SECOND], [[0, 0, 0], [1, 0, 0]], [up, [math.nan] * 4])
    assert [pose.heading for pose in path.at([0, SECOND // 2, SECOND], 2) if pose is not None] == [None] * 3


def test_a_file_of_tum_keeps_its_times_exactly(tmp_path: Path) -> None:
    file = tmp_path / "path.txt"
    file.write_text(
        "# time x y z qx qy qz qw\n\n1700000000.123456789 1 2 3 0 0 1 1  # turned\n1700000001,4,5,6,0,0,0,2\n"
    )
    found = read_trajectory(file)
    path = found.judged.trajectory
    assert not found.by_frame and path.nanoseconds.tolist() == [1_700_000_000_123_456_789, 1_700_000_001 * SECOND]
    first, last = path.at(path.nanoseconds, 0)
    assert first is not None and last is not None
    assert (first.x, first.y, first.z) == (1, 2, 3) and first.heading == pytest.approx(90)
    assert (last.x, last.heading) == (4, 0)


def test_a_file_of_kitti_is_turned_from_camera_axes(tmp_path: Path) -> None:
    left = Rotation.from_euler("y", -90, degrees=True).as_matrix()  # about the axis that points down
    rows = [np.hstack([np.eye(3), [[0], [0], [0]]]), np.hstack([left, [[-1], [-2], [10]]])]
    (tmp_path / "poses.txt").write_text("".join(" ".join(map(str, row.ravel())) + "\n" for row in rows))
    (tmp_path / "times.txt").write_text("0\n0.5\n")
    found = read_trajectory(tmp_path / "poses.txt", tmp_path / "times.txt")
    assert not found.by_frame
    _, pose = found.judged.trajectory.at([0, SECOND // 2], 1)
    assert pose is not None
    assert (pose.x, pose.y, pose.z) == pytest.approx((10, 1, 2))  # ahead, to the left, up
    assert pose.heading == pytest.approx(90)
    assert read_trajectory(tmp_path / "poses.txt").by_frame


MATRIX = "1 0 0 0 0 1 0 0 0 0 1 0"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "has no pose"),
        ("# only a remark\n", "has no pose"),
        ("1 2 3\n", "line 1: 3 values are neither"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 1\n", "line 2: there are 7 values, not 8"),
        ("0 0 0 0 0 0 0 1\n1 0 zero 0 0 0 0 1\n", "line 2: 'zero' is not a number"),
        ("0 0 0 nan 0 0 0 1\n", "line 1: a value is not a finite number"),
        ("now 0 0 0 0 0 0 1\n", "line 1: 'now' is not a time in seconds"),
        ("1e30 0 0 0 0 0 0 1\n", "line 1: '1e30' is not a time"),
        ("0 1e12 0 0 0 0 0 1\n", "a position beyond 1e.09 m"),
        (f"{MATRIX}\n{MATRIX} 1\n", "line 2: there are 13 values, not 12"),
        ("0 0 0 0 0 0 0 0 0 0 0 0\n", "line 1: the matrix has no rotation"),
    ],
)
def test_malformed_lines_are_named(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "path.txt").write_text(content)
    with pytest.raises(InvalidTrajectory, match=message):
        read_trajectory(tmp_path / "path.txt")


def test_files_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    (tmp_path / "kitti.txt").write_text(f"{MATRIX}\n" * 3)
    (tmp_path / "tum.txt").write_text("0 0 0 0 0 0 0 1\n")
    (tmp_path / "times.txt").write_text("0\n1\n")
    with pytest.raises(InvalidTrajectory, match=r"has 3 poses and .* has 2 times"):
        read_trajectory(tmp_path / "kitti.txt", tmp_path / "times.txt")
    with pytest.raises(InvalidTrajectory, match="form of TUM, which has its times itself"):
        read_trajectory(tmp_path / "tum.txt", tmp_path / "times.txt")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InvalidTrajectory, match="is not text"):
        read_trajectory(tmp_path / "binary")
    with pytest.raises(InvalidTrajectory, match="cannot be read"):
        read_trajectory(tmp_path / "missing")
