"""A map as a folder with a sparse model of COLMAP's text format, without points, as hloc and others read it.

images/                             the frames, and places.csv, by which placerec enrols the folder again
sparse/0/cameras.txt, images.txt    the cameras with their intrinsics, the poses of the frames; points3D.txt is empty
intrinsics.txt                      for each frame its camera, as hloc lists queries
origin.txt                          of a map in degrees: the point of the Earth at which x and y are 0

A pose is the turn and the shift from the world to the camera, whose axes are right, down and ahead.  COLMAP counts
pixels from the corner of the first one, and the maps of placerec from its centre.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from core.frames.intrinsics import Intrinsics
from core.maps.formats.frames import ArchivedFrame, ArchivedFrames
from core.recordings.folder import COLUMNS, FILE_NAME

GUESS = 1.2
"""The focal length of a camera without intrinsics, in longer sides of the frame: COLMAP's own guess."""


@dataclass
class ColmapFolder:
    """The outcome of writing a folder.

    frames, posed: how many frames there are, and how many of them have a pose and a heading.
    guessed: names of cameras whose focal length is a guess.
    """

    frames: int = 0
    posed: int = 0
    guessed: set[str] = field(default_factory=set)


def write_colmap(frames: ArchivedFrames, folder: Path) -> ColmapFolder:
    """Write the frames of a map into an empty folder.

    Raises:
        InvalidArchive: the export file is damaged.
        OSError: the folder cannot be written.
    """
    made, cameras = ColmapFolder(), dict[tuple[str, int, int], int]()
    images, model = folder / "images", folder / "sparse" / "0"
    images.mkdir()
    model.mkdir(parents=True)
    with (
        (images / FILE_NAME).open("w", newline="", encoding="utf-8") as listing,
        (model / "images.txt").open("w", encoding="utf-8") as poses,
        (model / "cameras.txt").open("w", encoding="utf-8") as lenses,
        (folder / "intrinsics.txt").open("w", encoding="utf-8") as intrinsics,
    ):
        places = csv.writer(listing)
        places.writerow(COLUMNS)
        poses.write("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then its points: none\n")
        lenses.write("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n")
        for frame in frames:
            made.frames += 1
            name = f"{frame.place.id}{frame.suffix}"
            (images / name).write_bytes(frame.data)
            places.writerow(_row(frame, name))
            lens = _lens(frame, made)
            kind = (frame.camera, frame.width, frame.height)
            if kind not in cameras:
                cameras[kind] = len(cameras) + 1
                lenses.write(f"{cameras[kind]} {lens}\n")
            intrinsics.write(f"{name} {lens}\n")
            made.posed += _write_pose(poses, frame, made.frames, cameras[kind], name)
    (model / "points3D.txt").write_text("# There are no points.\n")
    if frames.origin is not None:
        (folder / "origin.txt").write_text(f"{frames.origin.latitude!r} {frames.origin.longitude!r}\n")
    return made


def _row(frame: ArchivedFrame, name: str) -> list[object]:
    """The row of places.csv."""
    pose = frame.place.pose
    told, exact = {"file": name, "id": frame.place.id, "level": frame.place.level or ""}, frame.place.pose_accuracy
    posed = {} if pose is None else pose.model_dump(exclude_none=True)
    taken = {} if frame.place.timestamp is None else {"timestamp": frame.place.timestamp.isoformat()}
    accuracy = {} if exact is None else {f"accuracy_{name}": "" if value is None else value for name, value in exact}
    fields: dict[str, object] = {**told, **posed, **taken, **accuracy}
    return [fields.get(column, "") for column in COLUMNS]


def _write_pose(poses: TextIO, frame: ArchivedFrame, number: int, camera: int, name: str) -> bool:
    """Write the pose of a frame, with an empty line for its points; false if it has no pose, or no heading."""
    if frame.stands is None or frame.stands.yaw is None:
        return False
    turn, shift = from_world(frame.stands.position, frame.stands.yaw)
    numbers = " ".join(repr(float(one)) for one in (*turn, *shift))
    poses.write(f"{number} {numbers} {camera} {name}\n\n")
    return True


def from_world(position: NDArray[np.float64], yaw: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The quaternion w, x, y, z, float64 [4], and the shift, float64 [3], from the world to a level camera."""
    from scipy.spatial.transform import Rotation

    cos, sin = np.cos(yaw), np.sin(yaw)
    matrix = np.array([[sin, -cos, 0], [0, 0, -1], [cos, sin, 0]])  # rows: right, down, ahead
    x, y, z, w = Rotation.from_matrix(matrix).as_quat()
    return np.array([w, x, y, z]), -matrix @ position


def _lens(frame: ArchivedFrame, made: ColmapFolder) -> str:
    """The model of a frame's camera, its size and parameters."""
    if frame.intrinsics is not None:
        model, numbers = _model(frame.intrinsics)
    else:
        made.guessed.add(frame.camera)
        focal = GUESS * max(frame.width, frame.height)
        model, numbers = "SIMPLE_PINHOLE", [focal, frame.width / 2, frame.height / 2]
    return f"{model} {frame.width} {frame.height} " + " ".join(repr(float(one)) for one in numbers)


def _model(known: Intrinsics) -> tuple[str, Iterable[float]]:
    """COLMAP's name of a lens, and its parameters."""
    pinhole = [known.fx, known.fy, known.cx + 0.5, known.cy + 0.5]
    distortion = list(known.distortion)
    if not any(distortion):
        return "PINHOLE", pinhole
    if known.distortion_model == "equidistant":
        return "OPENCV_FISHEYE", [*pinhole, *distortion]
    if len(distortion) == 4:
        return "OPENCV", [*pinhole, *distortion]
    return "FULL_OPENCV", [*pinhole, *distortion, *[0.0] * (8 - len(distortion))]
