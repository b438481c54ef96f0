"""A traverse on disk that is to be enrolled: the frames of a directory, their ids and their poses."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from core.frames.exif import read_pose_and_time
from core.frames.traverses import find_images
from core.places import PlaceFields, Pose, Sequence, Timestamp, check_place_id
from service.commands.console import Failure

FILE_NAME = "places.csv"
POSE = ("x", "y", "z", "heading", "latitude", "longitude")
COLUMNS = ("file", "id", *POSE, "timestamp")


@dataclass(frozen=True)
class Frame:
    """One image to enrol.

    Args:
        path: the image file.
        id: the id of its place.
        sequence: the name of the traverse.
        listed: whether ``places.csv`` lists it; otherwise pose and timestamp come from its EXIF data.
        pose, timestamp: as listed; None if the list does not give them.
        camera: the camera of the map that took it; None for none.
    """

    path: Path
    id: str
    sequence: str
    listed: bool
    pose: Pose | None = None
    timestamp: Timestamp | None = None
    camera: str | None = None

    def parameters(self, data: bytes) -> dict[str, str]:
        """What goes into the query string beside the frame's bytes ``data``."""
        pose, timestamp = (self.pose, self.timestamp) if self.listed else read_pose_and_time(data)
        given = {} if pose is None else {name: repr(value) for name, value in pose if value is not None}
        if timestamp is not None:
            given["timestamp"] = timestamp.isoformat()
        if self.camera is not None:
            given["camera"] = self.camera
        return {**given, "sequence": self.sequence}


class _Sequence(BaseModel):
    name: Sequence


class _Row(BaseModel):
    """The cells of one row of ``places.csv`` that are not empty."""

    model_config = ConfigDict(extra="ignore")

    x: float | None = None
    y: float | None = None
    z: float | None = None
    heading: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    timestamp: Timestamp | None = None


def read_traverse(directory: Path, sequence: str | None, prefix: str) -> list[Frame]:
    """The frames of a directory: those that its ``places.csv`` lists, in that order, or all its images.

    Args:
        directory: of the images.
        sequence: name of the traverse; None for the name of the directory.
        prefix: of the ids that are made from file names.

    Raises:
        InvalidTraverse: the directory has neither a list nor an image.
        Failure: the list is malformed or names a missing file, or two frames have the same id.
    """
    name = check_sequence(directory.resolve().name if sequence is None else sequence)
    listed = directory / FILE_NAME
    if listed.is_file():
        frames = list(_listed_frames(listed, name, prefix))
        if not frames:
            raise Failure(f"{listed} lists no frame.")
    else:
        frames = [Frame(path, place_id(path, prefix), name, listed=False) for path in find_images(directory)]
    first: dict[str, Path] = {}
    for frame in frames:
        if frame.id in first:
            raise Failure(
                f"{first[frame.id].name} and {frame.path.name} would both have the id {frame.id!r}; "
                f"give their ids in {FILE_NAME}."
            )
        first[frame.id] = frame.path
    return frames


def check_sequence(name: str) -> str:
    """Return ``name`` if a traverse may have it.

    Raises:
        Failure: a traverse may not have this name.
    """
    try:
        return _Sequence(name=name).name
    except ValidationError as error:
        raise Failure(f"A sequence cannot have the name {name!r}; give another one with --sequence.") from error


def place_id(path: Path, prefix: str = "") -> str:
    """The id of a place made from a file name without its extension; other characters become hyphens.

    Raises:
        Failure: no character of an id is left.
    """
    made = re.sub(r"[^A-Za-z0-9._~-]+", "-", prefix + path.stem)
    made = re.sub(r"^[^A-Za-z0-9]+", "", made)[:128]
    if not made.strip("-"):
        raise Failure(f"No id can be made from the file name {path.name!r}; give one in {FILE_NAME}.")
    return made


def unlisted(directory: Path, frames: list[Frame]) -> int:
    """The number of images in the directory that its list leaves out."""
    if not frames[0].listed:
        return 0
    return len({path.resolve() for path in find_images(directory)} - {frame.path.resolve() for frame in frames})


def _listed_frames(path: Path, sequence: str, prefix: str) -> Iterator[Frame]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True, strict=True)
            columns = [(name or "").strip() for name in reader.fieldnames or []]
            _check_columns(path, columns)
            reader.fieldnames = columns
            for cells in reader:
                yield _listed_frame(path, reader.line_num, cells, sequence, prefix)
    except OSError as error:
        raise Failure(f"{path} cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise Failure(f"{path} is not a CSV file in UTF-8: {error}.") from error


def _check_columns(path: Path, columns: list[str]) -> None:
    unknown = [name for name in columns if name not in COLUMNS]
    if unknown or "file" not in columns or len(set(columns)) < len(columns):
        wrong = f"an unknown column {unknown[0]!r}" if unknown else "columns missing or given twice"
        raise Failure(f"{path} has {wrong}. Its first line must name 'file' and may name {', '.join(COLUMNS[1:])}.")


def _listed_frame(path: Path, line: int, cells: dict[str, str], sequence: str, prefix: str) -> Frame:
    where = f"{path.name}, line {line}"
    if None in cells or None in cells.values():
        raise Failure(f"{where}: the row has more or fewer cells than the first line.")
    given = {name: cell.strip() for name, cell in cells.items() if cell.strip()}
    image = path.parent / given.get("file", "")
    if "file" not in given or not image.is_file():
        raise Failure(f"{where}: there is no file {given.get('file', '')!r}.")
    try:
        row = _Row.model_validate(given)
        pose = {name: value for name in POSE if (value := getattr(row, name)) is not None}
        fields = PlaceFields(pose=Pose.model_validate(pose) if pose else None, timestamp=row.timestamp)
    except ValidationError as error:
        fault = error.errors()[0]
        location = "".join(f"{part}: " for part in fault["loc"])
        raise Failure(f"{where}: {location}{fault['msg'].removeprefix('Value error, ')}.") from error
    chosen = check_place_id(given["id"]) if "id" in given else place_id(image, prefix)
    return Frame(image, chosen, sequence, listed=True, pose=fields.pose, timestamp=fields.timestamp)
