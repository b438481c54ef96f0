"""Descriptors, local descriptors and codes by row; rows that no place has any more; and the stamps of revisions.

A row is given to one frame of one place and never used again.  What is stored of it is followed by its CRC-32, which
covers the kind of value and the row, so that another row's does not match it.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal

from sqlalchemy import Table, bindparam, delete, exists, func, select, union, update

from core.ledger.maps import frames
from core.ledger.maps.checksums import DamagedRow
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import CODES, DEAD_ROWS, DESCRIPTORS, KEYPOINTS, LOCALS, PICTURES, PLACES, REVISIONS
from core.ledger.statements import Statement, among, seconds_now

Kind = Literal["descriptors", "locals", "codes"]

OF_FRAMES: tuple[Kind, Kind] = ("descriptors", "locals")
"""What the descriptors of a frame are, apart from the code that is made of them."""

LEFT_SECONDS = 60
"""What no place names any more is deleted after this time; queries that need it have ended by then."""

REMEMBERED_SECONDS = 7 * 24 * 3600
"""How long it is remembered which rows died, so that a service need not read a whole map again."""

CLEARED_AT_ONCE = 16
"""Rows that are deleted with one COMMIT, whose log needs as much room as they had."""

ERASED = 2
"""The value of the column ``cleared`` of rows of which nothing is left on the disk."""

_TABLES: dict[Kind, Table] = {"descriptors": DESCRIPTORS, "locals": LOCALS, "codes": CODES}
_SUM_BYTES = 4
_R = DEAD_ROWS.c


def _of_map(table: Table) -> Any:
    return table.c.map == bindparam("map")


def _put(table: Table) -> Statement:
    return Statement(lambda insert: insert(table).values({name: bindparam(name) for name in ("map", "row", "bytes")}))


_PUT = {kind: _put(table) for kind, table in _TABLES.items()}
_AT = {
    kind: Statement(select(table.c.row, table.c.bytes).where(_of_map(table), among(table.c.row, "rows")))
    for kind, table in _TABLES.items()
}
_ALL = {
    kind: Statement(select(table.c.row, table.c.bytes).where(_of_map(table)).order_by(table.c.row))
    for kind, table in _TABLES.items()
}
_DELETE = {
    kind: Statement(delete(table).where(_of_map(table), among(table.c.row, "rows"))) for kind, table in _TABLES.items()
}
_OF_NO_PLACE = Statement(
    union(
        *(
            select(table.c.row).where(
                _of_map(table),
                ~exists().where(PLACES.c.map == table.c.map, PLACES.c.row == table.c.row),
                ~exists().where(_R.map == table.c.map, _R.number == table.c.row),
            )
            for table in (DESCRIPTORS, LOCALS, CODES, PICTURES, KEYPOINTS)
        )
    )
)
_UNCODED = Statement(
    select(DESCRIPTORS.c.row)
    .where(
        _of_map(DESCRIPTORS),
        ~exists().where(CODES.c.map == DESCRIPTORS.c.map, CODES.c.row == DESCRIPTORS.c.row),
    )
    .order_by(DESCRIPTORS.c.row)
)
_HAS_PLACE = exists().where(PLACES.c.map == _R.map, PLACES.c.row == _R.number)  # whose number was damaged
_OF_PLACES = Statement(select(_R.number).where(_of_map(DEAD_ROWS), _HAS_PLACE))
_LEAVE = Statement(
    lambda insert: (
        insert(DEAD_ROWS)
        .values({name: bindparam(name) for name in ("map", "number", "revision")} | {"since": seconds_now()})
        .on_conflict_do_nothing()
    )
)
_DEAD_SINCE = Statement(select(_R.number).where(_of_map(DEAD_ROWS), _R.revision > bindparam("after")))
_OLD = Statement(
    select(_R.number)
    .where(
        _of_map(DEAD_ROWS),
        _R.cleared == 0,
        _R.since < seconds_now() - bindparam("age"),
        ~_HAS_PLACE,
    )
    .order_by(_R.since)
    .limit(bindparam("most"))
    .with_for_update(skip_locked=True)
)
_COUNTS = Statement(
    select(func.count().filter(_R.cleared == 0), func.count().filter(_R.cleared < ERASED)).where(
        _of_map(DEAD_ROWS), ~_HAS_PLACE
    )
)
_NOTE_ERASED = Statement(update(DEAD_ROWS).where(_of_map(DEAD_ROWS), _R.cleared == 1).values(cleared=ERASED))
_CLEAR = Statement(update(DEAD_ROWS).where(_of_map(DEAD_ROWS), among(_R.number, "rows")).values(cleared=1))
_FORGET = Statement(
    delete(DEAD_ROWS).where(_of_map(DEAD_ROWS), _R.cleared > 0, _R.since < seconds_now() - bindparam("age"))
)
_NOTE_REVISION = Statement(
    lambda insert: insert(REVISIONS).values(
        {name: bindparam(name) for name in ("map", "revision", "stamp")} | {"since": seconds_now()}
    )
)
_STAMP_OF = Statement(
    select(REVISIONS.c.stamp).where(_of_map(REVISIONS), REVISIONS.c.revision == bindparam("revision"))
)
_FORGET_REVISIONS = Statement(
    delete(REVISIONS).where(_of_map(REVISIONS), REVISIONS.c.since < seconds_now() - bindparam("age"))
)


def _sum(kind: Kind, row: int, content: bytes | memoryview) -> bytes:
    return zlib.crc32(content, zlib.crc32(b"%b %d" % (kind.encode(), row))).to_bytes(_SUM_BYTES, "big")


def put(connection: MapConnection, kind: Kind, contents: Mapping[int, bytes]) -> None:
    """Store what new rows have of one kind."""
    values = [{"row": row, "bytes": content + _sum(kind, row, content)} for row, content in contents.items()]
    if values:
        connection.execute_many(_PUT[kind], values)


def replace(connection: MapConnection, kind: Kind, contents: Mapping[int, bytes]) -> None:
    """Store what rows have of one kind in the place of any other."""
    connection.execute(_DELETE[kind], rows=list(contents))
    put(connection, kind, contents)


def at(connection: MapConnection, kind: Kind, rows: Sequence[int], damaged: set[int] | None = None) -> dict[int, bytes]:
    """What rows have of one kind; rows that are gone are left out.

    Args:
        damaged: gets the rows whose content does not match its checksum, which are left out; None: those raise.

    Raises:
        DamagedRow: the content of one does not match its checksum.
    """
    return dict(_sound(kind, connection.execute(_AT[kind], rows=list(rows)), damaged))


def every(connection: MapConnection, kind: Kind, at_once: int, damaged: set[int]) -> Iterator[list[tuple[int, bytes]]]:
    """Row and content of all rows that have some of one kind, in order, some at a time.

    Args:
        damaged: gets the rows whose content does not match its checksum, which are left out.
    """
    for page in connection.pages(_ALL[kind], at_once):
        yield list(_sound(kind, page, damaged))


def _sound(
    kind: Kind, found: Iterable[tuple[int, bytes]], damaged: set[int] | None = None
) -> Iterator[tuple[int, bytes]]:
    for row, stored in found:
        if isinstance(stored, bytes) and _sum(kind, row, content := stored[:-_SUM_BYTES]) == stored[-_SUM_BYTES:]:
            yield row, content
        elif damaged is None:
            raise DamagedRow(f"row {row} of {kind} does not match its checksum")
        else:
            damaged.add(row)


def uncoded(connection: MapConnection) -> list[int]:
    """The rows that have a descriptor and no code."""
    return [row for (row,) in connection.execute(_UNCODED)]


def of_no_place(connection: MapConnection) -> list[int]:
    """Rows of which something is stored, and that no place has or had."""
    return [row for (row,) in connection.execute(_OF_NO_PLACE)]


# Rows that no place has any more


def dead_of_places(connection: MapConnection) -> list[int]:
    """Rows that are noted as dead though a place has them."""
    return [row for (row,) in connection.execute(_OF_PLACES)]


def leave(connection: MapConnection, row: int, revision: int) -> None:
    """Note that a row is no place's any more, from a revision of the map on."""
    connection.execute(_LEAVE, number=row, revision=revision)


def clear(connection: MapConnection, at_once: bool = False) -> int:
    """Delete what is stored of some rows that died a while ago; returns how many of them there were.

    Args:
        at_once: also of those that died a moment ago.
    """
    age = -1 if at_once else LEFT_SECONDS
    rows = [row for (row,) in connection.execute(_OLD, age=age, most=CLEARED_AT_ONCE)]
    if rows:
        for statement in _DELETE.values():
            connection.execute(statement, rows=rows)
        frames.delete_frames(connection, rows)
        connection.execute(_CLEAR, rows=rows)
        connection.execute(_FORGET, age=REMEMBERED_SECONDS)
        connection.execute(_FORGET_REVISIONS, age=REMEMBERED_SECONDS)
    return len(rows)


def left(connection: MapConnection) -> tuple[int, int]:
    """How many rows have died of which something is stored yet, and of which something may be left on the disk."""
    ((uncleared, unerased),) = connection.execute(_COUNTS)
    return int(uncleared), int(unerased)


def note_erased(connection: MapConnection) -> None:
    """Note that nothing is left of rows that were deleted."""
    connection.execute(_NOTE_ERASED)


def dead_since(connection: MapConnection, revision: int) -> list[int]:
    """The rows that died after a revision of the map."""
    return [row for (row,) in connection.execute(_DEAD_SINCE, after=revision)]


# Revisions


def note_revision(connection: MapConnection, revision: int, stamp: str) -> None:
    """Store the stamp of a revision, within the write that makes it."""
    connection.execute(_NOTE_REVISION, revision=revision, stamp=stamp)


def stamp_of(connection: MapConnection, revision: int) -> str | None:
    """The stamp of a revision; None: it was never made, or long ago."""
    found = connection.one(_STAMP_OF, revision=revision)
    return None if found is None else str(found[0])
