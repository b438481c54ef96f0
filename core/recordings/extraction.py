"""Frames of a recording as a folder of pictures, for readers of files."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

from core.errors import InvalidImage, InvalidRecording
from core.frames.containers import read_header
from core.recordings.folder import FILE_NAME, POSE
from core.recordings.frame import RecordedFrame

SUFFIXES = {"jpeg": ".jpg", "png": ".png", "webp": ".webp"}


def extract(frames: Iterable[RecordedFrame], folder: Path) -> list[Path]:
    """Write frames as picture files into an empty folder, one at a time, with their poses in ``places.csv``.

    The files are called after the numbers of the frames from 0 and after their ids, so that their names have the order
    of the frames.

    Returns:
        The files in the order of the frames.

    Raises:
        InvalidRecording: a frame cannot be used; the text names it.
        OSError: the folder cannot be written.
    """
    paths = []
    rows: list[list[object]] = []
    for number, frame in enumerate(frames):
        try:
            data = frame.load()
            suffix = SUFFIXES[read_header(data).format]
        except (InvalidImage, InvalidRecording) as error:
            raise InvalidRecording(f"{frame.name}: {error}") from error
        path = folder / f"{number:06d}-{frame.id}{suffix}"
        path.write_bytes(data)
        paths.append(path)
        pose = frame.described(data).pose
        if pose is not None:
            rows.append([path.name, *(getattr(pose, name) for name in POSE)])
    if rows:
        with (folder / FILE_NAME).open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([["file", *POSE], *rows])
    return paths
