"""A traverse to enrol: which frames a directory holds, under which ids, and where they were taken."""

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

    pose, timestamp: None where the file's own EXIF data decide.
    camera: of the map, whose mask is applied; None: none.
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
    """The cells of one row of ``places.csv``; an empty cell counts as left out."""

    model_config = ConfigDict(extra="ignore")

    x: float | None = None
    y: float | None = None
    z: float | None = None
    heading: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    timestamp: Timestamp | None = None


def read_traverse(directory: Path, sequence: str | None, prefix: str) -> list[Frame]:
    """The frames of a directory: those of its ``places.csv`` in that order, else all its images.

    Args:
        sequence: name of the traverse; that of the directory if None.
        prefix: put before the ids that are made from file names.

    Raises:
        InvalidTraverse: there is neither a list nor an image.
        Failure: the list is malformed, names a file that is not there, or two frames have one id.
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
                f"name the ids in {FILE_NAME}."
            )
        first[frame.id] = frame.path
    return frames


def check_sequence(name: str) -> str:
    """``name`` if it can name a traverse.

    Raises:
        Failure: it cannot.
    """
    try:
        return _Sequence(name=name).name
    except ValidationError as error:
        raise Failure(f"{name!r} cannot name a sequence; give another with --sequence.") from error


def place_id(path: Path, prefix: str = "") -> str:
    """An id made of a file's name without its ending: what ids cannot hold becomes a hyphen.

    Raises:
        Failure: nothing usable is left.
    """
    made = re.sub(r"[^A-Za-z0-9._~-]+", "-", prefix + path.stem)
    made = re.sub(r"^[^A-Za-z0-9]+", "", made)[:128]
    if not made.strip("-"):
        raise Failure(f"No id can be made of the file name {path.name!r}; name it in {FILE_NAME}.")
    return made


def unlisted(directory: Path, frames: list[Frame]) -> int:
    """How many images lie in the directory that its list leaves out."""
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
        raise Failure(f"{path} has {wrong}: its first line names 'file' and, of these, what is known: {COLUMNS[1:]}.")


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
