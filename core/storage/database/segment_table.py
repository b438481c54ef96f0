"""What SQLite says of the segment files."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass

from core.disk.files import Damage
from core.storage.files.segment_files import Layout


@dataclass(frozen=True)
class NamedSegment:
    """What SQLite says of a segment file; of one that is ``removed`` no row is alive, and no file need be there."""

    number: int
    rows: int
    checksum: int
    removed: bool = False


def named_segments(connection: sqlite3.Connection, layout: Layout) -> list[NamedSegment]:
    """The segments in order.

    Raises:
        Damage: one is missing, or one that is not the last is not full.
    """
    query = "SELECT number, rows, checksum, removed FROM segments ORDER BY number"
    rows = connection.execute(query).fetchall()
    found = [NamedSegment(number, count, checksum, bool(removed)) for number, count, checksum, removed in rows]
    for position, segment in enumerate(found):
        if not all(isinstance(value, int) for value in (segment.number, segment.rows, segment.checksum)):
            raise Damage(f"map.sqlite: what it says of segment {position + 1} makes no sense")
        full, last = segment.rows == layout.rows_per_segment, position == len(found) - 1
        if segment.number != position or segment.rows > layout.rows_per_segment or not (full or last):
            raise Damage(f"map.sqlite: segment {position + 1} is not as long as it must be")
    return found
