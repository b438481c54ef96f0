"""Checksums of the rows of the tables of a map's record, its places and its cameras.

SQLite has no checksums of its own and does not notice a flipped bit in a pose or in a place's metadata.  The column
``seal`` of a row is the CRC-32 of its columns that are listed here; a row without one is not checked.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

CHECKED: Mapping[str, Sequence[str]] = {
    "map": (
        "id", "encoder", "dimension", "rows_per_segment", "description", "keep", "same_place_radius",
        "same_place_frames", "calibration", "revision", "created_at", "updated_at", "local_cells", "local_values",
        "index", "precision", "verification", "review",
    ),
    "places": (
        "number", "id", "row", "checksum", "digest", "regions", "picture", "x", "y", "z", "latitude", "longitude",
        "heading", "timestamp", "sequence", "ordinal", "metadata", "created_at", "updated_at", "camera",
        "track", "station", "pose_of",
    ),
    "cameras": ("name", "mask", "updated_at", "intrinsics"),
}  # fmt: skip

"""The columns of each table that its rows' checksums cover, in this order."""

_NAMES = {"map": "id", "places": "id", "cameras": "name"}
_FUNCTION = "row_checksum"


def checksum_of(*values: Any) -> int:
    """The checksum of a row with these values, as SQLite returns them."""
    return zlib.crc32(ascii(values).encode())


def is_sound(values: Sequence[Any], seal: int | None) -> bool:
    """Whether a row matches its checksum, if it has one."""
    return seal is None or seal == checksum_of(*values)


def register(connection: sqlite3.Connection) -> None:
    """Make the checksum available to the statements of a connection."""
    connection.create_function(_FUNCTION, -1, checksum_of, deterministic=True)


def _expression(table: str) -> str:
    """The SQL expression of a row's checksum."""
    columns = ", ".join(f'"{column}"' for column in CHECKED[table])
    return f"{_FUNCTION}({columns})"


def write_checksums(connection: sqlite3.Connection, table: str, condition: str = "true", *values: Any) -> None:
    """Write the checksums of the rows for which an SQL condition holds; to be called after every change of a row."""
    connection.execute(f"UPDATE {table} SET seal = {_expression(table)} WHERE {condition}", values)


def mismatched(connection: sqlite3.Connection, table: str) -> list[str]:
    """The names of the rows of a table that do not match their checksum."""
    query = f"SELECT {_NAMES[table]} FROM {table} WHERE seal IS NOT NULL AND seal <> {_expression(table)}"
    return [str(name) for (name,) in connection.execute(query).fetchall()]
