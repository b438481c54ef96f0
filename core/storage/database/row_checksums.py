"""Checksums of the rows of the tables of a map's record, its places and its cameras.

SQLite has no checksums of its own and does not notice a flipped bit in a pose or in a place's metadata.  The column
``seal`` of a row is the CRC-32 of its columns that are listed here; a row without one is not checked.  A migration that
adds a column has to list it in ``ADDED`` and to write the checksums of all rows again (:func:`sealing`).
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

_FIRST: Mapping[str, Sequence[str]] = {
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

ADDED: Sequence[Mapping[str, Sequence[str]]] = (
    {"map": ("verification",), "places": ("track", "station", "pose_of"), "cameras": ("intrinsics",)},
    {"map": ("review",)},
)
"""The columns that each migration of the tables added to those of the first release."""


def _columns(table: str, migrations: int) -> Sequence[str]:
    """The columns of a table that the checksums of its rows cover after so many migrations, in this order."""
    return [*_FIRST[table], *(column for added in ADDED[:migrations] for column in added.get(table, ()))]


CHECKED: Mapping[str, Sequence[str]] = {table: _columns(table, len(ADDED)) for table in _FIRST}
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


def expression(table: str, migrations: int = len(ADDED)) -> str:
    """The SQL expression of a row's checksum, in tables to which so many migrations were applied."""
    columns = ", ".join(f'"{column}"' for column in _columns(table, migrations))
    return f"{_FUNCTION}({columns})"


def sealing(migration: int) -> list[str]:
    """The last statements of a migration, which write the checksums of all rows again with the columns that it added.

    A row that does not match its checksum keeps it, and so does not match it afterwards either.

    Args:
        migration: its number, counted from 0.
    """
    return [
        f"UPDATE {table} SET seal = {expression(table, migration + 1)} WHERE seal = {expression(table, migration)}"
        for table in ADDED[migration]
    ]


def write_checksums(connection: sqlite3.Connection, table: str, condition: str = "true", *values: Any) -> None:
    """Write the checksums of the rows for which an SQL condition holds; to be called after every change of a row."""
    connection.execute(f"UPDATE {table} SET seal = {expression(table)} WHERE {condition}", values)


def mismatched(connection: sqlite3.Connection, table: str) -> list[str]:
    """The names of the rows of a table that do not match their checksum."""
    query = f"SELECT {_NAMES[table]} FROM {table} WHERE seal IS NOT NULL AND seal <> {expression(table)}"
    return [str(name) for (name,) in connection.execute(query).fetchall()]
