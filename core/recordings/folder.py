"""A folder of pictures: those that its ``places.csv`` lists, in that order, or all, in natural order.

Poses are those of the list; without one, those in the names of the files (:mod:`core.recordings.pose_names`) if more
than half have that form; else those of the EXIF data.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import AliasChoices, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from core.errors import InvalidImage, InvalidRecording, InvalidTraverse
from core.frames.containers import read_header, read_structure
from core.frames.traverses import find_images
from core.names import composed
from core.numerals import check_numeral
from core.places import LEVEL_KEYS, Level, PlaceFields, Pose, PoseAccuracy, Timestamp, check_place_id, microseconds
from core.recordings.frame import RecordedFrame, make_id
from core.recordings.pictures import sendable
from core.recordings.pose_names import NamedPose, named_pose

FILE_NAME = "places.csv"
POSE = ("x", "y", "z", "heading", "latitude", "longitude")
ACCURACY = ("accuracy_metres", "accuracy_degrees")
COLUMNS = ("file", "id", *POSE, "timestamp", "level", *ACCURACY)
MOST_NAMED = 3
"""Files whose names say no pose that one remark names."""

JPEG, LONGEST_HEAD = b"\xff\xd8\xff", 128 << 10
"""The first bytes of a JPEG file, and how many are read for its EXIF data, of which there are 64 KiB at most."""


_Cell = Annotated[float, BeforeValidator(lambda text: check_numeral(text.removeprefix("+")))]


class _Row(BaseModel):
    """The cells of one row of ``places.csv`` that are not empty."""

    model_config = ConfigDict(extra="ignore")

    x: _Cell | None = None
    y: _Cell | None = None
    z: _Cell | None = None
    heading: _Cell | None = None
    latitude: _Cell | None = None
    longitude: _Cell | None = None
    timestamp: Timestamp | None = None
    level: Level | None = Field(default=None, validation_alias=AliasChoices(*LEVEL_KEYS))
    accuracy_metres: _Cell | None = None
    accuracy_degrees: _Cell | None = None


class _Found(NamedTuple):
    """A picture of the folder with its frame, and the line of ``places.csv`` that lists it; None without a list."""

    path: Path
    frame: RecordedFrame
    line: int | None = None


class FolderFrames(NamedTuple):
    """The frames of a directory.

    remarks: sentences about them that a user must know.
    lost: how many names say no pose, although poses are those in the names.
    lost_by: a sentence that names the first of these, which is a remark, too; there may be none.
    """

    frames: list[RecordedFrame]
    remarks: list[str]
    lost: int = 0
    lost_by: Sequence[str] = ()


def folder_frames(directory: Path, prefix: str = "", by_names: bool = False) -> FolderFrames:
    """The frames of a directory, and remarks on them; a frame has its name as its id if no id can be made of it.

    Args:
        prefix: of the ids that are made from file names.
        by_names: whether poses are those in the names, also if there is a list, or few names have one; names of other
            forms are not counted as lost then.

    Raises:
        InvalidTraverse: the directory has neither a list nor an image; the list is malformed or names a missing file;
            two frames have the same id; or the names have no poses, or poses in several zones.
    """
    listed = directory / FILE_NAME
    remarks: list[str] = []
    lost, lost_by = 0, ""
    if listed.is_file() and not by_names:
        found = list(_listed_frames(listed, prefix))
        if not found:
            raise InvalidTraverse(f"{listed} lists no frame.")
        left_out = len({path.resolve() for path in find_images(directory)} - {one.path.resolve() for one in found})
        if left_out:
            remarks.append(f"{left_out} images of {directory} are not listed in {FILE_NAME} and are left out.")
    else:
        images = find_images(directory)
        poses = _named_poses(images, by_names, remarks)
        if any(poses):
            lost, lost_by = _without_pose(images, by_names)
            remarks += [lost_by] if lost_by else []
        frames = [_frame(path, prefix, pose) for path, pose in zip(images, poses, strict=True)]
        found = [_Found(path, _described(path, frame)) for path, frame in zip(images, frames, strict=True)]
    _check_ids(found)
    return FolderFrames([one.frame for one in found], remarks, lost, [lost_by] if lost else [])


def _frame(path: Path, prefix: str, pose: NamedPose | None) -> RecordedFrame:
    """A picture that no list names; its time, and its pose where names have none, are those of its EXIF data."""
    embedded, at = pose is None or pose.pose is not None, None if pose is None else pose.pose
    return RecordedFrame(_id(path, prefix), path.name, partial(read_picture, path), at, embedded=embedded)


def _named_poses(images: list[Path], wanted: bool, remarks: list[str]) -> list[NamedPose | None]:
    """The poses in the names of some pictures; none of all if they are not wanted and half of the names have none.

    Raises:
        InvalidTraverse: they are wanted, and no name has one; or they are of several zones.
    """
    found = [named_pose(path.name) for path in images]
    posed = [one.pose for one in found if one is not None and one.pose is not None]
    if wanted and not posed:
        raise InvalidTraverse(
            f"No file name of {images[0].parent} says a pose, as @east@north@…@heading@…@.jpg does: leave out --poses."
        )
    few = 2 * found.count(None) >= len(images)
    if not wanted and (not posed or few):
        if posed:
            remarks.append(
                f"{len(posed)} of {len(images)} file names say a pose (@east@north@…), and the others do not: poses "
                "are those of EXIF data; with --poses names they are those of the names."
            )
        elif not few and (said := _without_pose(images, True)[1]):
            remarks.append(f"{said} Poses are those of EXIF data.")
        return [None] * len(images)
    zones = sorted({one.zone for one in found if one is not None and one.zone})
    if len(zones) > 1:
        raise InvalidTraverse(
            f"The file names are of several zones of UTM ({', '.join(zones)}), whose metres lie in no common frame: "
            "enrol the pictures of each zone into a map of its own."
        )
    headed = sum(pose.heading is not None for pose in posed)
    remarks.append(
        f"Poses are those in the file names (@east@north@…{f', UTM zone {zones[0]}' if zones else ''}): {len(posed)} "
        f"of {len(images)} frames have one, {headed} with a heading."
    )
    return [NamedPose(None) if one is None else one for one in found]


def _without_pose(images: list[Path], wanted: bool) -> tuple[int, str]:
    """How many names say no pose by mistake, and a sentence on the first ones that say none; "" if each has its form.

    Args:
        wanted: whether names of other forms are no mistake.
    """
    faults = []
    lost = 0
    for path in images:
        found = named_pose(path.name)
        if found is None or found.fault:
            faults.append(f"{path.name} ({'another form' if found is None else found.fault})")
            lost += found is not None or not wanted
    named = ", ".join(faults[:MOST_NAMED]) + (", …" if len(faults) > MOST_NAMED else "")
    return lost, f"{len(faults)} of {len(images)} file names say no pose that can be: {named}." if faults else ""


def _check_ids(found: list[_Found]) -> None:
    """Check that no two frames have the same id.

    Raises:
        InvalidTraverse: two have it; the message has their lines if a list names them.
    """
    first: dict[str, _Found] = {}
    for one in found:
        earlier = first.setdefault(one.frame.id, one)
        if earlier is one:
            continue
        if one.line is None:
            raise InvalidTraverse(
                f"{earlier.path.name} and {one.path.name} would both have the id {one.frame.id!r}; "
                f"give their ids in {FILE_NAME}."
            )
        where = f"{FILE_NAME}, line {one.line}"
        if one.path == earlier.path:
            raise InvalidTraverse(
                f"{where}: {one.path.name} is listed in line {earlier.line} already, with the same id "
                f"{one.frame.id!r}; remove one of the lines, or give them different ids."
            )
        raise InvalidTraverse(
            f"{where}: {earlier.path.name} and {one.path.name} would both have the id {one.frame.id!r}, which line "
            f"{earlier.line} has already; give them different ids."
        )


def picture_frame(path: Path) -> RecordedFrame:
    """A single image file as a frame; its pose and time are those of its EXIF data."""
    return RecordedFrame(_id(path, ""), str(path), partial(read_picture, path), embedded=True)


def _described(path: Path, frame: RecordedFrame) -> RecordedFrame:
    """A frame with the pose and the time of a JPEG file whose beginning has them all; any other one as it is."""
    try:
        with path.open("rb") as file:
            head = file.read(LONGEST_HEAD)
        if not head.startswith(JPEG):
            return frame
        read_structure(head, read_header(head))
    except (OSError, InvalidImage):
        return frame
    return frame.described(head, with_zeros=True)


def read_picture(path: Path) -> bytes:
    """The bytes of an image file as the service takes them.

    Raises:
        OSError: it cannot be read.
        InvalidImage: it is none.
    """
    return sendable(path.read_bytes())


def _id(path: Path, prefix: str) -> str:
    """The id that a file's name makes; the name itself, which is the id of no place, where it makes none."""
    try:
        return make_id(path.stem, prefix)
    except InvalidRecording:
        return prefix + path.stem


def _listed_frames(path: Path, prefix: str) -> Iterator[_Found]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True, strict=True)
            columns = [(name or "").strip() for name in reader.fieldnames or []]
            _check_columns(path, columns)
            reader.fieldnames = columns
            for cells in reader:
                yield _listed_frame(path, reader.line_num, cells, prefix)
    except OSError as error:
        raise InvalidTraverse(f"{path} cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidTraverse(f"{path} is not a CSV file in UTF-8: {error}.") from error


def _check_columns(path: Path, columns: list[str]) -> None:
    named = ["level" if name in LEVEL_KEYS else name for name in columns]
    unknown = [name for name in named if name not in COLUMNS]
    if unknown or "file" not in columns or len(set(named)) < len(columns):
        wrong = f"an unknown column {unknown[0]!r}" if unknown else "columns missing or given twice"
        raise InvalidTraverse(
            f"{path} has {wrong}. Its first line must name 'file' and may name {', '.join(COLUMNS[1:])}."
        )


def _in_any_form(path: Path) -> Path:
    """A file of this name, or of one that differs from it in its form of Unicode alone; the path itself if none is."""
    if path.name.isascii() or path.is_file() or not path.parent.is_dir():
        return path
    return next((one for one in path.parent.iterdir() if composed(one.name) == composed(path.name)), path)


def _listed_frame(path: Path, line: int, cells: dict[str, str], prefix: str) -> _Found:
    where = f"{path.name}, line {line}"
    if None in cells or None in cells.values():
        raise InvalidTraverse(f"{where}: the row has more or fewer cells than the first line.")
    given = {name: cell.strip() for name, cell in cells.items() if cell.strip()}
    image = _in_any_form(path.parent / given.get("file", ""))
    if "file" not in given or not image.is_file():
        raise InvalidTraverse(f"{where}: there is no file {given.get('file', '')!r}.")
    try:
        row = _Row.model_validate(given)
        pose = {name: value for name in POSE if (value := getattr(row, name)) is not None}
        exact = {name: value for name in ACCURACY if (value := getattr(row, name)) is not None}
        fields = PlaceFields(
            pose=Pose.model_validate(pose) if pose else None,
            timestamp=row.timestamp,
            level=row.level,
            pose_accuracy=PoseAccuracy.model_validate(
                {name.removeprefix("accuracy_"): value for name, value in exact.items()}
            )
            if exact
            else None,
        )
    except ValidationError as error:
        fault = error.errors()[0]
        location = "".join(f"{part}: " for part in fault["loc"])
        raise InvalidTraverse(f"{where}: {location}{fault['msg'].removeprefix('Value error, ')}.") from error
    chosen = check_place_id(given["id"]) if "id" in given else _id(image, prefix)
    taken = None if fields.timestamp is None else 1000 * microseconds(fields.timestamp)
    load = partial(read_picture, image)
    frame = RecordedFrame(
        chosen, image.name, load, fields.pose, fields.timestamp, taken, level=fields.level,
        pose_accuracy=fields.pose_accuracy,
    )  # fmt: skip
    return _Found(image, frame, line)
