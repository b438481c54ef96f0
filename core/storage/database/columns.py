"""Reading all places of a map from SQLite as NumPy columns: a million of them in seconds."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.disk.files import Damage
from core.places import EARTH_RADIUS, GEOGRAPHIC, METRIC, NO_POSE, Pose, Whereabouts

_AT_ONCE = 65_536
_NUMBERS = (
    "row, checksum, sequence, ordinal, x, y, z, latitude, longitude, heading,"
    " coalesce(track, sequence), coalesce(station, ordinal)"
)


@dataclass(frozen=True, eq=False)
class Columns:
    """The places of a map, in any order.

    rows: int64 [n], of their descriptors.
    checksums: uint32 [n], of these rows.
    """

    rows: NDArray[np.int64]
    checksums: NDArray[np.uint32]
    whereabouts: Whereabouts


def read_columns(connection: sqlite3.Connection, rows: int) -> Columns:
    """Row, checksum and whereabouts of every place.

    Args:
        rows: how many descriptor rows the map has.

    Raises:
        Damage: a place has a row that is in no segment.
        ValueError: a pose is invalid.
    """
    cursor = connection.execute(f"SELECT {_NUMBERS}, substr(timestamp, 1, 26) FROM places")
    numbers, moments = [np.empty((0, 12))], [np.empty(0, "datetime64[us]")]
    while part := cursor.fetchmany(_AT_ONCE):
        numbers.append(np.array([values[:12] for values in part], dtype=np.float64))
        moments.append(np.array([values[12] for values in part], dtype="datetime64[us]"))
    found = np.concatenate(numbers)
    row = found[:, 0].astype(np.int64)
    if len(row) and row.max() >= rows:
        raise Damage(f"map.sqlite: a place has row {row.max()}, but there are {rows}")
    if len(row) and row.min() < 0:
        raise Damage("map.sqlite: a place has no row")
    kind, position = _positions(found[:, 4:9], found[:, 9])
    whereabouts = Whereabouts(
        kind,
        position,
        found[:, 2].astype(np.int32),
        found[:, 3].astype(np.int64),
        found[:, 9].astype(np.float32),
        np.concatenate(moments).astype(np.int64),
        found[:, 10].astype(np.int32),
        found[:, 11].astype(np.int64),
    )
    return Columns(row, found[:, 1].astype(np.uint32), whereabouts)


def _positions(
    coordinates: NDArray[np.float64], heading: NDArray[np.float64]
) -> tuple[NDArray[np.int8], NDArray[np.float64]]:
    """Kind and position (``Pose.position``) of columns x, y, z, latitude, longitude; NaN is a missing value."""
    there = ~np.isnan(coordinates)
    metric, geographic = there[:, 0] & there[:, 1], there[:, 3] & there[:, 4]
    whole = (metric & ~there[:, 3:].any(axis=1)) | (geographic & ~there[:, :3].any(axis=1))
    nothing = ~there.any(axis=1) & np.isnan(heading)
    for odd in np.flatnonzero(~(whole | nothing))[:1].tolist():
        names = (*("x", "y", "z", "latitude", "longitude"), "heading")
        values: list[Any] = [*coordinates[odd].tolist(), float(heading[odd])]
        Pose(**{name: value for name, value in zip(names, values, strict=True) if value == value})  # raises ValueError
    kind = np.where(metric, METRIC, np.where(geographic, GEOGRAPHIC, NO_POSE)).astype(np.int8)
    phi, theta = np.radians(coordinates[:, 3]), np.radians(coordinates[:, 4])
    sphere = EARTH_RADIUS * np.stack([np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)], axis=1)
    return kind, np.where(metric[:, None], np.nan_to_num(coordinates[:, :3]), np.nan_to_num(sphere))
