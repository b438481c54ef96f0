"""Ground truth by poses: which references were taken within a distance of a query, in metres and degrees."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from core.errors import InvalidGroundTruth
from core.frames.traverses import Truth
from core.places import Pose
from core.recordings.pose_names import named_pose

FILE_NAME = "places.csv"
COLUMNS = ("x", "y", "z", "heading", "latitude", "longitude")


def read_poses(images: Sequence[Path]) -> list[Pose]:
    """The pose of each image of one directory.

    They come from ``places.csv`` beside the images (``file`` and x, y[, z] or latitude, longitude,
    [heading]; other columns are ignored), else from names such as ``@easting@northing@…@.jpg``,
    else from the EXIF data of the files.

    Raises:
        InvalidGroundTruth: an image has no pose, or the list is malformed.
    """
    if not images:
        return []
    listed = images[0].parent / FILE_NAME
    poses = _listed(listed) if listed.is_file() else {}
    found = [poses.get(path.name) if poses else _named(path) or _embedded(path) for path in images]
    for path, pose in zip(images, found, strict=True):
        if pose is None:
            raise InvalidGroundTruth(
                f"{path} has no pose: list it in {listed} (file and x,y or latitude,longitude), or let its name or "
                "its EXIF data say where it was taken."
            )
    return [pose for pose in found if pose is not None]


def within_truth(queries: Sequence[Pose], references: Sequence[Pose], metres: float, degrees: float | None) -> Truth:
    """Query i shows what the references within ``metres`` show, without those that face another way.

    Args:
        degrees: how far two headings may differ; None takes every heading.

    Raises:
        InvalidGroundTruth: poses are in two frames, one has no heading that needs one, or none is near another.
    """
    at_queries, at_references = _positions(queries, references)
    truth, closest = near(at_queries, at_references, metres)
    if degrees is not None:
        truth = [
            found[_turns([query], [references[index] for index in found])[0] <= degrees] if len(found) else found
            for query, found in zip(queries, truth, strict=True)
        ]
    if not any(len(found) for found in truth):
        raise InvalidGroundTruth(
            f"no query lies within {metres:g} m of a reference (the nearest {closest:.1f} m off)"
            + ("." if degrees is None else f" and looks the same way within {degrees:g}°.")
        )
    return truth


def near(queries: NDArray[np.float64], references: NDArray[np.float64], metres: float) -> tuple[Truth, float]:
    """The references within ``metres`` of each query, and the least distance of any two.

    Args:
        queries, references: positions of queries and references, float64 [Q, d] and [R, d].
    """
    from scipy.spatial import KDTree

    tree = KDTree(references)
    found = [np.array(sorted(row), np.int64) for row in tree.query_ball_point(queries, metres * (1 + 1e-12), workers=1)]
    return found, float(tree.query(queries)[0].min())


def nearest_truth(queries: Sequence[Pose], references: Sequence[Pose], frames: int) -> Truth:
    """Query i shows what the nearest reference and ``frames`` frames before and after it show (Berlin, section 2.4).

    Raises:
        InvalidGroundTruth: poses are in two frames.
    """
    at_queries, at_references = _positions(queries, references)
    # A row at a time: Q x R differences of long traverses would not fit into memory.
    nearest = [int(np.linalg.norm(at_references - position, axis=1).argmin()) for position in at_queries]
    return [
        np.arange(max(0, index - frames), min(len(references), index + frames + 1), dtype=np.int64) for index in nearest
    ]


def _positions(queries: Sequence[Pose], references: Sequence[Pose]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The positions of queries and references, float64 [Q, 3] and [R, 3]."""
    if len({pose.kind() for pose in [*queries, *references]}) > 1:
        raise InvalidGroundTruth("some poses are in metres and others in degrees: they cannot be compared.")
    return np.stack([pose.position() for pose in queries]), np.stack([pose.position() for pose in references])


def _turns(queries: Sequence[Pose], references: Sequence[Pose]) -> NDArray[np.float64]:
    """Degrees between the headings of each query and each reference, 0 to 180; float64 [Q, R]."""
    headings = [[pose.heading for pose in poses] for poses in (queries, references)]
    if any(heading is None for side in headings for heading in side):
        raise InvalidGroundTruth("a pose without a heading cannot be held to a number of degrees.")
    at_queries, at_references = (np.array(side, np.float64) for side in headings)
    return np.abs((at_queries[:, None] - at_references[None, :] + 180) % 360 - 180)


def _listed(path: Path) -> dict[str, Pose]:
    """The poses of a list by file name; a row without one is left out."""
    poses = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            for cells in reader:
                given = {name.strip(): cell.strip() for name, cell in cells.items() if name and cell and cell.strip()}
                fields = {name: given[name] for name in COLUMNS if name in given}
                if "file" in given and fields.keys() - {"heading"}:
                    poses[given["file"]] = _pose(fields, f"{path}, line {reader.line_num}")
    except OSError as error:
        raise InvalidGroundTruth(f"{path} cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidGroundTruth(f"{path} is not a CSV file in UTF-8: {error}.") from error
    return poses


def _pose(fields: dict[str, str], where: str) -> Pose:
    try:
        return Pose.model_validate(fields)
    except ValidationError as error:
        raise InvalidGroundTruth(f"{where}: {error.errors()[0]['msg'].removeprefix('Value error, ')}.") from error


def _named(path: Path) -> Pose | None:
    found = named_pose(path.name)
    return None if found is None else found.pose


def _embedded(path: Path) -> Pose | None:
    from core.frames.exif import read_pose_and_time

    try:
        return read_pose_and_time(path.read_bytes())[0]
    except OSError as error:
        raise InvalidGroundTruth(f"{path} cannot be read: {error.strerror}.") from error
