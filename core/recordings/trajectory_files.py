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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidTrajectory
from core.recordings.frame import NANOSECONDS
from core.recordings.plausibility import LARGEST_COORDINATE, MOST_SPEED, Source
from core.recordings.trajectory import JudgedTrajectory

TUM_VALUES, KITTI_VALUES = 8, 12
LATEST = Decimal(2**63 - 1) / NANOSECONDS

FROM_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""From the axes of KITTI's cameras to x forward, y left, z up, in which a heading lies in the plane of x and y."""

LEAST_DETERMINANT, LARGEST_DETERMINANT = 0.9, 1.1
"""A rotation has 1; files are written with few digits."""


class TrajectoryFile(NamedTuple):
    """The content of a trajectory file.

    by_frame: whether it has a pose for each frame in place of times: its times are then the frames' numbers from 0.
    poses: how many lines have one, also those that are left out.
    """

    judged: JudgedTrajectory
    by_frame: bool
    poses: int


def read_trajectory(
    path: Path, times: Path | None = None, most_speed: float = MOST_SPEED, absolute: bool = False
) -> TrajectoryFile:
    """Read a trajectory file; the number of values in its lines decides its form.

    Args:
        times: of a file in the form of KITTI: a file with a line of seconds for each pose.
        most_speed: metres a second; no vehicle is faster.
        absolute: as of ``judge``; so are the coordinates of a ground truth.

    Raises:
        InvalidTrajectory: a file cannot be read, a line is malformed, no line has a pose, or the files have different
            lengths.
    """
    lines = list(_lines(path))
    if not lines:
        raise InvalidTrajectory(f"{path} has no pose.")
    values = len(lines[0][1])
    if values == TUM_VALUES:
        if times is not None:
            raise InvalidTrajectory(f"{path} is in the form of TUM, which has its times itself: give no second file.")
        return TrajectoryFile(_tum(path, lines, most_speed, absolute), False, len(lines))
    if values == KITTI_VALUES:
        return TrajectoryFile(_kitti(path, lines, times, most_speed, absolute), times is None, len(lines))
    raise InvalidTrajectory(
        f"{path.name}, line {lines[0][0]}: {values} values are neither a pose of TUM (time x y z qx qy qz qw) "
        f"nor of KITTI (twelve values of a matrix)."
    )


def _tum(path: Path, lines: list[tuple[int, list[str]]], most_speed: float, absolute: bool) -> JudgedTrajectory:
    nanoseconds, rows = list[int](), []
    for number, cells in lines:
        _check_count(path, number, cells, TUM_VALUES)
        taken, row = _time(path, number, cells[0]), _numbers(path, number, cells[1:])
        if taken is None:
            taken = nanoseconds[-1] if nanoseconds else 0
            row = [math.nan] * len(row)  # a pose of no moment is none
        nanoseconds.append(taken)
        rows.append(row)
    table = np.array(rows)
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(table[:, 3:], axis=1)
        turns = np.where((lengths >= 0.5)[:, None], table[:, 3:] / lengths[:, None], math.nan)
    where = _with_times([f"in line {number}" for number, _ in lines], nanoseconds)
    return _judged(path, where, nanoseconds, table[:, :3], turns, most_speed, absolute)


def _with_times(where: list[str], nanoseconds: list[int]) -> list[str]:
    return [f"{line}, {taken / NANOSECONDS:.3f} s" for line, taken in zip(where, nanoseconds, strict=True)]


def _kitti(
    path: Path, lines: list[tuple[int, list[str]]], times: Path | None, most_speed: float, absolute: bool
) -> JudgedTrajectory:
    from scipy.spatial.transform import Rotation

    for number, cells in lines:
        _check_count(path, number, cells, KITTI_VALUES)
    matrices = np.array([_numbers(path, number, cells) for number, cells in lines]).reshape(-1, 3, 4)
    with np.errstate(over="ignore", invalid="ignore"):
        sizes = np.linalg.det(matrices[:, :, :3])
    turned = (sizes > LEAST_DETERMINANT) & (sizes < LARGEST_DETERMINANT)
    if not turned.any():
        raise InvalidTrajectory(f"{path.name}, line {lines[0][0]}: the matrix has no rotation.")
    positions = np.where(turned[:, None], matrices[:, :, 3] @ FROM_CAMERA.T, math.nan)
    turns = np.full((len(lines), 4), math.nan)
    turns[turned] = Rotation.from_matrix(FROM_CAMERA @ matrices[turned, :, :3] @ FROM_CAMERA.T).as_quat()
    nanoseconds = [number * NANOSECONDS for number in range(len(lines))] if times is None else _times(times)
    if len(nanoseconds) != len(lines):
        raise InvalidTrajectory(f"{path} has {len(lines)} poses and {times} has {len(nanoseconds)} times.")
    where = [f"in line {number}" for number, _ in lines]
    if times is not None:
        where = _with_times(where, nanoseconds)
    return _judged(path, where, nanoseconds, positions, turns, most_speed, absolute)


def _judged(
    path: Path,
    where: list[str],
    nanoseconds: list[int],
    positions: NDArray[np.float64],
    turns: NDArray[np.float64],
    most_speed: float,
    absolute: bool,
) -> JudgedTrajectory:
    """Judge the poses of lines.

    Raises:
        InvalidTrajectory: none of them has a pose.
    """
    if not (np.abs(positions) <= LARGEST_COORDINATE).all(axis=1).any():
        first = where[0].removeprefix("in ").partition(",")[0]
        raise InvalidTrajectory(
            f"{path.name}, {first}: a value is not a finite number, or a position beyond {LARGEST_COORDINATE:g} m, as "
            "in all lines."
        )
    source = Source(path.name, "lines", where.__getitem__)
    return JudgedTrajectory.of_samples(nanoseconds, positions, turns, source, absolute=absolute, most_speed=most_speed)


def _times(path: Path) -> list[int]:
    found = []
    for number, cells in _lines(path):
        _check_count(path, number, cells, 1)
        taken = _time(path, number, cells[0])
        if taken is None:
            raise InvalidTrajectory(f"{path.name}, line {number}: {cells[0][:80]!r} is not a time in seconds.")
        found.append(taken)
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


def _time(path: Path, number: int, text: str) -> int | None:
    """Seconds as nanoseconds, exactly: as a float they would be off by a fraction of a microsecond; None for NaN.

    Raises:
        InvalidTrajectory: it is no time.
    """
    try:
        seconds = Decimal(text)
        if seconds.is_nan():
            return None
        usable = abs(seconds) <= LATEST
    except InvalidOperation:
        usable = False
    if not usable:
        raise InvalidTrajectory(f"{path.name}, line {number}: {text[:80]!r} is not a time in seconds.")
    return int(seconds * NANOSECONDS)


def _numbers(path: Path, number: int, cells: list[str]) -> list[float]:
    """The numbers of a line, NaN and infinity among them.

    Raises:
        InvalidTrajectory: a value is no number at all.
    """
    found = []
    for cell in cells:
        try:
            found.append(float(cell))
        except ValueError as error:
            raise InvalidTrajectory(f"{path.name}, line {number}: {cell[:80]!r} is not a number.") from error
    return found
