"""The records of segment files in a map's database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import CheckConstraint, Column, MetaData, Table, bindparam, func, select, update

from core.disk.files import Damage
from core.ledger.maps.checksums import DamagedRow, checksum_of
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import PLACES
from core.ledger.statements import Statement, integer
from core.storage.files.segment_files import Layout, segment_checksum

METADATA = MetaData()

# How many rows a full segment has; the seal is the checksum of that.
_LAYOUT = Table(
    "layout", METADATA, Column("rows_per_segment", integer(), CheckConstraint("rows_per_segment > 0"), nullable=False),
    Column("seal", integer(), nullable=False), sqlite_strict=True,
)  # fmt: skip
# Of each segment file: how many rows it has, and the checksum of their checksums.  The files of removed segments,
# which are without a place, are deleted (:mod:`core.storage.removed_segments`).
_SEGMENTS = Table(
    "segments", METADATA, Column("number", integer(), primary_key=True),
    Column("rows", integer(), CheckConstraint("rows > 0"), nullable=False),
    Column("checksum", integer(), nullable=False), Column("removed", integer(), nullable=False, server_default="0"),
    sqlite_strict=True,
)  # fmt: skip
_S = _SEGMENTS.c

_PUT_LAYOUT = Statement(
    lambda insert: insert(_LAYOUT).values(rows_per_segment=bindparam("rows"), seal=bindparam("seal"))
)
_READ_LAYOUT = Statement(select(_LAYOUT.c.rows_per_segment, _LAYOUT.c.seal))
_ALL = Statement(select(_S.number, _S.rows, _S.checksum, _S.removed).order_by(_S.number))
_CHECKSUM = Statement(select(_S.checksum).where(_S.number == bindparam("number")))
_PUT = Statement(
    lambda insert: (
        put := insert(_SEGMENTS).values({name: bindparam(name) for name in ("number", "rows", "checksum")})
    ).on_conflict_do_update(
        index_elements=["number"], set_={"rows": put.excluded.rows, "checksum": put.excluded.checksum}
    )
)
_REMOVE = Statement(update(_SEGMENTS).where(_S.number == bindparam("which")).values(removed=1))
_PLACES_BETWEEN = Statement(
    select(func.count())
    .select_from(PLACES)
    .where(PLACES.c.map == bindparam("map"), PLACES.c.row >= bindparam("first"), PLACES.c.row < bindparam("end"))
)


@dataclass(frozen=True)
class SegmentEntry:
    """The record of a segment file in the database.

    number: counted from 0.
    checksum: of the checksums of its rows (:func:`core.storage.files.segment_files.segment_checksum`).
    removed: no row belongs to a place any more, and the file may be missing.
    """

    number: int
    rows: int
    checksum: int
    removed: bool = False


def put_rows_per_segment(connection: MapConnection, rows: int) -> None:
    """Store how many rows a full segment of a new map has."""
    connection.whole.execute(_PUT_LAYOUT, rows=rows, seal=checksum_of([rows]))


def rows_per_segment(connection: MapConnection) -> int:
    """The number of rows of a full segment.

    Raises:
        DamagedRow: it is not what was stored.
    """
    found = connection.whole.execute(_READ_LAYOUT)
    if len(found) != 1 or found[0][1] != checksum_of([found[0][0]]):
        raise DamagedRow("the map's own record cannot be read: it does not say how many rows a segment has")
    return int(found[0][0])


def segment_entries(connection: MapConnection, layout: Layout) -> list[SegmentEntry]:
    """The segments in their order.

    Raises:
        Damage: a segment is missing, or one before the last is not full.
    """
    rows = connection.whole.execute(_ALL)
    found = [SegmentEntry(number, count, checksum, bool(removed)) for number, count, checksum, removed in rows]
    for position, segment in enumerate(found):
        if not all(isinstance(value, int) for value in (segment.number, segment.rows, segment.checksum)):
            raise Damage(f"map.sqlite: its entry of segment {position + 1} is invalid")
        full, last = segment.rows == layout.rows_per_segment, position == len(found) - 1
        if segment.number != position or segment.rows > layout.rows_per_segment or not (full or last):
            raise Damage(f"map.sqlite: segment {position + 1} is not as long as it must be")
    return found


def record_appended(
    connection: MapConnection, layout: Layout, first_row: int, checksums: Sequence[int]
) -> dict[int, int]:
    """Record the rows that were appended to the segment files.

    Args:
        first_row: of those rows.
        checksums: of each row.

    Returns:
        The checksums of the segments that became full, by their numbers.
    """
    filled, done = {}, 0
    while done < len(checksums):
        number, offset = divmod(first_row + done, layout.rows_per_segment)
        part = checksums[done : done + layout.rows_per_segment - offset]
        before = connection.whole.execute(_CHECKSUM, number=number)
        checksum = segment_checksum(part, before[0][0] if before else 0)
        connection.whole.execute(_PUT, number=number, rows=offset + len(part), checksum=checksum)
        if offset + len(part) == layout.rows_per_segment:
            filled[number] = checksum
        done += len(part)
    return filled


def count_places_between(connection: MapConnection, first: int, end: int) -> int:
    """How many places have a row from ``first`` on and before ``end``."""
    return int(connection.execute(_PLACES_BETWEEN, first=first, end=end)[0][0])


def mark_removed(connection: MapConnection, number: int) -> None:
    """Record that a segment is removed."""
    connection.whole.change(_REMOVE, which=number)
