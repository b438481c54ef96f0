"""A checksum in each row of the tables that nothing else vouches for: the map's record, its places, its cameras.

SQLite has no checksums of its own: a bit that is flipped in a pose or in a place's metadata leaves its file in order.
The seal of a row is the CRC-32 of the values of the columns named here; a row without one was never sealed and passes.
A column that comes with a later migration is sealed once it is named here and that migration has sealed all rows anew.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

SEALED: Mapping[str, Sequence[str]] = {
    "map": (
        "id", "encoder", "dimension", "rows_per_segment", "description", "keep", "same_place_radius",
        "same_place_frames", "calibration", "revision", "created_at", "updated_at", "local_cells", "local_values",
        "index", "precision",
    ),
    "places": (
        "number", "id", "row", "checksum", "digest", "regions", "picture", "x", "y", "z", "latitude", "longitude",
        "heading", "timestamp", "sequence", "ordinal", "metadata", "created_at", "updated_at", "camera",
    ),
    "cameras": ("name", "mask", "updated_at"),
}  # fmt: skip
"""The columns that the seal of a row of each table is made of, in this order."""

_NAMES = {"map": "id", "places": "id", "cameras": "name"}
_FUNCTION = "seal_of"


def seal_of(*values: Any) -> int:
    """The seal of a row with these values, as SQLite gives them."""
    return zlib.crc32(ascii(values).encode())


def is_sound(values: Sequence[Any], seal: int | None) -> bool:
    """Whether a row has the seal that it must have, if it has one."""
    return seal is None or seal == seal_of(*values)


def teach(connection: sqlite3.Connection) -> None:
    """Let the statements of a connection make seals."""
    connection.create_function(_FUNCTION, -1, seal_of, deterministic=True)


def expression(table: str) -> str:
    """The seal of a row, in SQL."""
    columns = ", ".join(f'"{column}"' for column in SEALED[table])
    return f"{_FUNCTION}({columns})"


def seal(connection: sqlite3.Connection, table: str, condition: str = "true", *values: Any) -> None:
    """Seal the rows for which an SQL condition holds; for whoever has just written them."""
    connection.execute(f"UPDATE {table} SET seal = {expression(table)} WHERE {condition}", values)


def broken(connection: sqlite3.Connection, table: str) -> list[str]:
    """The names of the rows of a table that are not what was sealed."""
    query = f"SELECT {_NAMES[table]} FROM {table} WHERE seal IS NOT NULL AND seal <> {expression(table)}"
    return [str(name) for (name,) in connection.execute(query).fetchall()]


def statements() -> list[str]:
    """SQL that gives each of the tables its column and seals all rows there are."""
    return [
        statement
        for table in SEALED
        for statement in (
            f"ALTER TABLE {table} ADD COLUMN seal INTEGER",
            f"UPDATE {table} SET seal = {expression(table)}",
        )
    ]
