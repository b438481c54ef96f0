"""Checksums of rows.

SQLite has no checksums of its own and does not notice a flipped bit in a pose or in a place's metadata; PostgreSQL has
them where its cluster was made with them.  The column ``seal`` of a row is the CRC-32 of its other columns but the
map's number.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import Table

from core.disk.files import Damage


class DamagedRow(Damage):
    """A row does not match its checksum, or its values are none that were written."""


def sealed_columns(table: Table) -> tuple[str, ...]:
    """The columns that the checksum of a row covers, in this order."""
    return tuple(column.name for column in table.columns if column.name not in ("map", "seal"))


def checksum_of(values: Sequence[Any]) -> int:
    """The checksum of a row with these values, in the order of :func:`sealed_columns`."""
    return zlib.crc32(ascii(tuple(values)).encode())


def sealed(columns: Sequence[str], values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a row with its checksum."""
    return {**values, "seal": checksum_of([values[name] for name in columns])}


def is_sound(values: Sequence[Any], seal: int) -> bool:
    """Whether a row matches its checksum."""
    return bool(seal == checksum_of(values))
