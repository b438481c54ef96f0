"""Reading all places of a map as NumPy columns: a million of them in seconds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import bindparam, func, select

from core.ledger.maps.checksums import DamagedRow
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import PLACES
from core.ledger.statements import Statement
from core.places import EARTH_RADIUS, GEOGRAPHIC, METRIC, NO_POSE, NO_SEQUENCE, Pose, Whereabouts, level_code

_P = PLACES.c
_AT_ONCE = 65_536
_NUMBERS = 13
_COLUMNS = (
    select(
        _P.row, _P.sequence, _P.ordinal, _P.x, _P.y, _P.z, _P.latitude, _P.longitude, _P.heading,
        func.coalesce(_P.track, _P.sequence), func.coalesce(_P.station, _P.ordinal), _P.least,
        _P.accuracy_metres, func.substr(_P.timestamp, 1, 26), _P.level,
    ).where(_P.map == bindparam("map"))
)  # fmt: skip
_ALL = Statement(_COLUMNS)
_CHANGED = Statement(_COLUMNS.where(_P.revision > bindparam("after")))


@dataclass(frozen=True, eq=False)
class Columns:
    """The places of a map, in any order.

    rows: int64 [n], of their frames.
    """

    rows: NDArray[np.int64]
    whereabouts: Whereabouts

    def by_row(self, total: int) -> Whereabouts:
        """Where the frames of all rows of a map are; those of rows without a place are nowhere.

        Args:
            total: how many rows the map has.
        """
        found = Whereabouts(
            np.full(total, NO_POSE, np.int8),
            np.zeros((total, 3)),
            np.full(total, NO_SEQUENCE, np.int32),
            np.zeros(total, np.int64),
        )
        for name, column in vars(self.whereabouts).items():
            getattr(found, name)[self.rows] = column
        return found


def read_columns(connection: MapConnection, rows: int, after: int | None = None) -> Columns:
    """Row and whereabouts of every place.

    Args:
        rows: how many rows the map has.
        after: only places that changed since this revision of the map; None: all.

    Raises:
        DamagedRow: a place has a row that the map has not.
        ValueError: a pose is invalid.
    """
    numbers, moments = [np.empty((0, _NUMBERS))], [np.empty(0, "datetime64[us]")]
    levels: list[str | None] = []
    pages = connection.pages(_ALL, _AT_ONCE) if after is None else [connection.execute(_CHANGED, after=after)]
    for page in pages:
        numbers.append(np.array([values[:_NUMBERS] for values in page], np.float64).reshape(-1, _NUMBERS))
        moments.append(np.array([values[_NUMBERS] for values in page], dtype="datetime64[us]"))
        levels += [values[_NUMBERS + 1] for values in page]
    codes = {level: level_code(level) for level in set(levels)}
    found = np.concatenate(numbers)
    row = found[:, 0].astype(np.int64)
    if len(row) and row.max() >= rows:
        raise DamagedRow(f"a place has row {row.max()}, but there are {rows}")
    if len(row) and row.min() < 0:
        raise DamagedRow("a place has no row")
    kind, position = _positions(found[:, 3:8], found[:, 8])
    whereabouts = Whereabouts(
        kind,
        position,
        found[:, 1].astype(np.int32),
        found[:, 2].astype(np.int64),
        found[:, 8].astype(np.float32),
        np.concatenate(moments).astype(np.int64),
        found[:, 9].astype(np.int32),
        found[:, 10].astype(np.int64),
        np.where(np.isnan(found[:, 11]), -np.inf, found[:, 11]).astype(np.float32),
        np.array([codes[level] for level in levels], np.int32),
        found[:, 5],
        found[:, 12].astype(np.float32),
    )
    return Columns(row, whereabouts)


def _positions(
    coordinates: NDArray[np.float64], heading: NDArray[np.float64]
) -> tuple[NDArray[np.int8], NDArray[np.float64]]:
    """Kind and position (``Pose.position``) of columns x, y, z, latitude, longitude; NaN is a missing value."""
    there = ~np.isnan(coordinates)
    metric, geographic = there[:, 0] & there[:, 1], there[:, 3] & there[:, 4]
    whole = (metric & ~there[:, 3:].any(axis=1)) | (geographic & ~there[:, :2].any(axis=1))
    nothing = ~there.any(axis=1) & np.isnan(heading)
    for odd in np.flatnonzero(~(whole | nothing))[:1].tolist():
        names = (*("x", "y", "z", "latitude", "longitude"), "heading")
        values: list[Any] = [*coordinates[odd].tolist(), float(heading[odd])]
        Pose(**{name: value for name, value in zip(names, values, strict=True) if value == value})  # raises ValueError
    kind = np.where(metric, METRIC, np.where(geographic, GEOGRAPHIC, NO_POSE)).astype(np.int8)
    phi, theta = np.radians(coordinates[:, 3]), np.radians(coordinates[:, 4])
    sphere = EARTH_RADIUS * np.stack([np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)], axis=1)
    return kind, np.where(metric[:, None], np.nan_to_num(coordinates[:, :3]), np.nan_to_num(sphere))
