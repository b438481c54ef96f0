"""Layouts of one drive that comes back to places: each frame queries the frames of another time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidGroundTruth, InvalidTrajectory
from core.frames.traverses import Truth, find_images, natural_key, tolerance_truth
from core.places import Pose
from core.recordings.frame import NANOSECONDS
from core.recordings.trajectory_files import TrajectoryFile, read_trajectory
from lab.evaluation.data.layouts import DatasetLayout, LayoutTraverses, Names, present
from lab.evaluation.data.poses import near, within_truth

TUM_GAP = 0.1
"""Seconds between two poses that a frame may lie between."""


def kitti(sequence: str, metres: float, degrees: float, frames: int) -> DatasetLayout:
    """A sequence of KITTI's odometry benchmark (Geiger et al., CVPR 2012), as its archives unpack.

    Args:
        metres, degrees: two images within both show one place.
        frames: before and after an image, which is not matched against them.
    """
    cameras = tuple(f"sequences/{sequence}/image_{camera}" for camera in (2, 0, 3, 1))
    poses = f"poses/{sequence}.txt"

    def read(base: Path) -> LayoutTraverses:
        folder = present(base, cameras)
        assert folder is not None, "found"
        images = find_images(folder)
        told = _trajectory(base / poses)
        if not told.by_frame or told.poses != len(images):
            raise InvalidGroundTruth(f"{base / poses} has {told.poses} poses, and {folder} {len(images)} images.")
        found = told.judged.trajectory.at(np.arange(len(images), dtype=np.int64) * NANOSECONDS, 0.0)
        known = [index for index, pose in enumerate(found) if pose is not None]
        revisits = _revisits(
            [images[index] for index in known], [found[index] for index in known], metres, degrees, frames
        )
        return replace(revisits, notes=(*revisits.notes, *told.judged.remarks))

    return DatasetLayout("KITTI", "dataset", (cameras, (poses,)), read, poses, f"sequences/{sequence}")


def tum(metres: float, degrees: float, frames: int) -> DatasetLayout:
    """A sequence of TUM's RGB-D benchmark (Sturm et al., IROS 2012), as its archive unpacks.

    Args:
        metres, degrees, frames: as for :func:`kitti`.
    """

    def read(base: Path) -> LayoutTraverses:
        images = sorted(find_images(base / "rgb"), key=lambda path: natural_key(path.name))
        times = []
        for image in images:
            if not re.fullmatch(r"[0-9]{1,10}\.[0-9]{1,9}", image.stem):
                raise InvalidGroundTruth(f"{image} is not named by its time in seconds, as TUM's images are.")
            seconds, fraction = image.stem.split(".")
            times.append(int(seconds) * NANOSECONDS + int(fraction.ljust(9, "0")))
        found_there = _trajectory(base / "groundtruth.txt")
        if found_there.by_frame:
            raise InvalidGroundTruth(f"{base / 'groundtruth.txt'} has no times: it is not in the form of TUM.")
        judged = found_there.judged
        poses = judged.trajectory.at(times, TUM_GAP)
        known = [index for index, pose in enumerate(poses) if pose is not None]
        if not known:
            raise InvalidGroundTruth(f"{base / 'groundtruth.txt'} has no pose at the time of an image.")
        left_out = len(images) - len(known)
        gaps = f"{left_out} of {len(images)} images have no pose within {TUM_GAP:g} s and are left out."
        notes = (*((gaps,) if left_out else ()), *judged.remarks)
        chosen = [images[index] for index in known]
        found = _revisits(chosen, [poses[index] for index in known], metres, degrees, frames)
        return LayoutTraverses(found.references, found.queries, found.truth, found.excluded, notes)

    return DatasetLayout("TUM RGB-D", "", (("rgb",), ("groundtruth.txt",)), read, "groundtruth.txt")


def baidu(metres: float) -> DatasetLayout:
    """Baidu Mall (Sun et al., CVPR 2017): a file ``.camera`` for each image, whose last line but one is its place.

    Args:
        metres: a reference within them is true.
    """
    sides: tuple[tuple[Names, str], ...] = (
        (("training_images_undistort",), "training_gt"),
        (("query_images_undistort",), "query_gt"),
    )

    def read(base: Path) -> LayoutTraverses:
        (known, at_known), (queried, at_queried) = (_cameras(base / images[0], base / poses) for images, poses in sides)
        return LayoutTraverses(known, queried, near(at_queried, at_known, metres)[0])

    held = (*(images for images, _ in sides), *((poses,) for _, poses in sides))
    return DatasetLayout("Baidu", "baidu_datasets", held, read)


def _revisits(
    images: list[Path], poses: Sequence[Pose | None], metres: float, degrees: float, frames: int
) -> LayoutTraverses:
    """Each image against all but those ``frames`` before and after it."""
    found = [pose for pose in poses if pose is not None]
    assert len(found) == len(images), "each has a pose"
    excluded = tolerance_truth(len(images), len(images), frames)
    close = within_truth(found, found, metres, degrees)
    truth: Truth = [np.setdiff1d(true, out) for true, out in zip(close, excluded, strict=True)]
    if not any(len(true) for true in truth):
        raise InvalidGroundTruth(
            f"{images[0].parent} comes back to no place: no two images lie within {metres:g} m and {degrees:g}° of one "
            f"another and more than {frames} images apart."
        )
    return LayoutTraverses(images, images, truth, excluded)


def _trajectory(path: Path) -> TrajectoryFile:
    try:
        return read_trajectory(path, absolute=True)
    except InvalidTrajectory as error:
        raise InvalidGroundTruth(str(error)) from error


def _cameras(folder: Path, poses: Path) -> tuple[list[Path], NDArray[np.float64]]:
    images = find_images(folder)
    return images, np.array([_centre(poses / f"{image.stem}.camera", image) for image in images])


def _centre(path: Path, image: Path) -> list[float]:
    """The centre of projection of a ``.camera`` file, in metres."""
    try:
        lines = [line for line in path.read_text("utf-8").splitlines() if line.strip()]
        found = [float(cell) for cell in lines[-2].split()]
    except OSError as error:
        raise InvalidGroundTruth(f"{image} has no pose: {path} cannot be read ({error.strerror}).") from error
    except (UnicodeDecodeError, ValueError, IndexError) as error:
        raise InvalidGroundTruth(f"{path} is not a camera file: its last line but one is not x y z.") from error
    if len(found) != 3 or not np.isfinite(found).all():
        raise InvalidGroundTruth(f"{path} is not a camera file: its last line but one is not x y z.")
    return found
