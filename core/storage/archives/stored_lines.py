"""The lines of an export file from SQLite."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from typing import Any

from core.geometry.keypoints import count_of
from core.maps.archives.lines import written_line
from core.maps.archives.writing import ArchivedPlace


def sequence_lines(connection: sqlite3.Connection) -> Iterator[bytes]:
    """The lines of sequences by name; places without a sequence come first."""
    for name, following in connection.execute("SELECT name, next_ordinal FROM sequences ORDER BY name"):
        yield written_line({"name": name, "next_ordinal": following})


def camera_lines(connection: sqlite3.Connection) -> Iterator[bytes]:
    """The lines of cameras by name."""
    query = "SELECT name, mask, intrinsics, updated_at FROM cameras ORDER BY name"
    for name, mask, intrinsics, updated_at in connection.execute(query):
        stored = {"mask": mask, "intrinsics": intrinsics}
        parsed = {field: None if text is None else json.loads(text) for field, text in stored.items()}
        yield written_line({"name": name, **parsed, "updated_at": updated_at})


_POSE = ("x", "y", "z", "latitude", "longitude", "heading")
_PLACES = (
    "SELECT p.id, p.x, p.y, p.z, p.latitude, p.longitude, p.heading, p.timestamp, s.name, p.ordinal, p.camera,"
    " p.metadata, p.regions, lower(hex(p.digest)), p.picture, length(k.bytes), lower(hex(k.digest)),"
    " p.created_at, p.updated_at, p.number, p.row, p.checksum, p.track, p.station, t.name, length(f.record),"
    " p.pose_of"
    " FROM places p JOIN sequences s ON s.code = p.sequence LEFT JOIN pictures k ON k.place = p.number"
    " LEFT JOIN sequences t ON t.code = p.track LEFT JOIN keypoints f ON f.place = p.number"
    " ORDER BY p.number"
)


def _place(values: tuple[Any, ...], lost: dict[int, int]) -> ArchivedPlace:
    """A row of the places.

    Args:
        lost: the numbers of the tracks whose sequence is gone, by their codes; it gets those that it lacks.
    """
    pose = {name: value for name, value in zip(_POSE, values[1:7], strict=True) if value is not None}
    picture = None if values[15] is None else {"kind": values[14], "bytes": values[15], "sha256": values[16]}
    text = written_line(
        {
            "id": values[0],
            "pose": pose or None,
            "pose_of": values[26],
            "timestamp": values[7],
            "sequence": values[8],
            "ordinal": values[9],
            "track": None if values[22] is None else values[24] or lost.setdefault(values[22], len(lost)),
            "station": values[23],
            "camera": values[10],
            "metadata": json.loads(values[11]),
            "regions": values[12],
            "digest": values[13],
            "picture": picture,
            "keypoints": None if values[25] is None else count_of(values[25]),
            "created_at": values[17],
            "updated_at": values[18],
        }
    )
    number, row, checksum = (int(value) for value in values[19:22])
    return ArchivedPlace(values[0], text, number, row, checksum, values[15] or 0, values[25] or 0)


def place_lines(connection: sqlite3.Connection) -> Iterator[ArchivedPlace]:
    """The lines of all places in the order of their enrolment."""
    lost: dict[int, int] = {}
    for values in connection.execute(_PLACES):
        yield _place(values, lost)
