"""Trajectory files in the forms of TUM and KITTI.

TUM: a line ``time x y z qx qy qz qw`` for each pose, time in seconds.  KITTI: the twelve values of a 3 x 4 matrix for
each pose, row by row, in the axes of its cameras (x right, y down, z forward); times are in a file of their own, or
there is one pose for each frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidTrajectory
from core.recordings.frame import NANOSECONDS
from core.recordings.trajectory import Trajectory

TUM_VALUES, KITTI_VALUES = 8, 12
LATEST = Decimal(2**63 - 1) / NANOSECONDS

FROM_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""From the axes of KITTI's cameras to x forward, y left, z up, in which a heading lies in the plane of x and y."""

LEAST_DETERMINANT, LARGEST_DETERMINANT = 0.9, 1.1
"""A rotation has 1; files are written with few digits."""


def read_trajectory(path: Path, times: Path | None = None) -> tuple[Trajectory, bool]:
    """Read a trajectory file; the number of values in its lines decides its form.

    Args:
        times: of a file in the form of KITTI: a file with a line of seconds for each pose.

    Returns:
        The trajectory, and whether it has a pose for each frame in place of times: its times are then the frames'
        numbers from 0.

    Raises:
        InvalidTrajectory: a file cannot be read, a line is malformed, or the files have different lengths.
    """
    lines = list(_lines(path))
    if not lines:
        raise InvalidTrajectory(f"{path} has no pose.")
    values = len(lines[0][1])
    if values == TUM_VALUES:
        if times is not None:
            raise InvalidTrajectory(f"{path} is in the form of TUM, which has its times itself: give no second file.")
        return _tum(path, lines), False
    if values == KITTI_VALUES:
        return _kitti(path, lines, times), times is None
    raise InvalidTrajectory(
        f"{path.name}, line {lines[0][0]}: {values} values are neither a pose of TUM (time x y z qx qy qz qw) "
        f"nor of KITTI (twelve values of a matrix)."
    )


def _tum(path: Path, lines: list[tuple[int, list[str]]]) -> Trajectory:
    nanoseconds, rows = [], []
    for number, cells in lines:
        _check_count(path, number, cells, TUM_VALUES)
        nanoseconds.append(_time(path, number, cells[0]))
        rows.append(_numbers(path, number, cells[1:]))
    table = np.array(rows)
    lengths = np.linalg.norm(table[:, 3:], axis=1)
    if (wrong := np.flatnonzero(lengths < 0.5)).size:
        raise InvalidTrajectory(f"{path.name}, line {lines[wrong[0]][0]}: qx qy qz qw are no orientation.")
    return _of_samples(path, nanoseconds, table[:, :3], table[:, 3:] / lengths[:, None])


def _kitti(path: Path, lines: list[tuple[int, list[str]]], times: Path | None) -> Trajectory:
    from scipy.spatial.transform import Rotation

    for number, cells in lines:
        _check_count(path, number, cells, KITTI_VALUES)
    matrices = np.array([_numbers(path, number, cells) for number, cells in lines]).reshape(-1, 3, 4)
    sizes = np.linalg.det(matrices[:, :, :3])
    if (wrong := np.flatnonzero(~((sizes > LEAST_DETERMINANT) & (sizes < LARGEST_DETERMINANT)))).size:
        raise InvalidTrajectory(f"{path.name}, line {lines[wrong[0]][0]}: the matrix has no rotation.")
    positions = matrices[:, :, 3] @ FROM_CAMERA.T
    turns = Rotation.from_matrix(FROM_CAMERA @ matrices[:, :, :3] @ FROM_CAMERA.T).as_quat()
    nanoseconds = [number * NANOSECONDS for number in range(len(lines))] if times is None else _times(times)
    if len(nanoseconds) != len(lines):
        raise InvalidTrajectory(f"{path} has {len(lines)} poses and {times} has {len(nanoseconds)} times.")
    return _of_samples(path, nanoseconds, positions, turns)


def _of_samples(
    path: Path, nanoseconds: list[int], positions: NDArray[np.float64], turns: NDArray[np.float64]
) -> Trajectory:
    try:
        return Trajectory.of_samples(nanoseconds, positions, turns)
    except InvalidTrajectory as error:
        raise InvalidTrajectory(f"{path}: {error}") from error


def _times(path: Path) -> list[int]:
    found = []
    for number, cells in _lines(path):
        _check_count(path, number, cells, 1)
        found.append(_time(path, number, cells[0]))
    return found


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The values of each line that is neither blank nor a remark, with its number from 1."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(file, start=1):
                cells = line.partition("#")[0].replace(",", " ").split()
                if cells:
                    yield number, cells
    except OSError as error:
        raise InvalidTrajectory(f"{path} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise InvalidTrajectory(f"{path} is not text.") from error


def _check_count(path: Path, number: int, cells: list[str], count: int) -> None:
    if len(cells) != count:
        raise InvalidTrajectory(f"{path.name}, line {number}: there are {len(cells)} values, not {count}.")


def _time(path: Path, number: int, text: str) -> int:
    """Seconds as nanoseconds, exactly: as a float they would be off by a fraction of a microsecond."""
    try:
        seconds = Decimal(text)
        usable = seconds.is_finite() and abs(seconds) <= LATEST
    except InvalidOperation:
        usable = False
    if not usable:
        raise InvalidTrajectory(f"{path.name}, line {number}: {text[:80]!r} is not a time in seconds.")
    return int(seconds * NANOSECONDS)


def _numbers(path: Path, number: int, cells: list[str]) -> list[float]:
    try:
        found = [float(cell) for cell in cells]
    except ValueError:
        found = [math.nan]
    if not all(map(math.isfinite, found)):
        raise InvalidTrajectory(f"{path.name}, line {number}: a value is not a finite number.")
    return found
