"""Descriptors by row, and rows and keys that no place has any more."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from sqlalchemy import bindparam, column, delete, func, select, table, union, update

from core.errors import UnknownMap
from core.ledger.database import LedgerConnection
from core.ledger.maps import frames
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import MAPS, PLACES
from core.ledger.postgres import PostgresConnection
from core.ledger.statements import Statement, among, seconds_now
from core.postgres.tables import DEAD_KEYS, DEAD_ROWS, DESCRIPTORS, REVISIONS

WAIT_SECONDS = 10
"""A write that waits for others to the same map is refused after this time."""

WRITING = 7061
"""The kind of the locks of the database by which writes to a map are paused; their number is that of the map."""

LEFT_SECONDS = 60
"""Data that no place names any more is deleted after this time; queries that need it have ended by then."""

REMEMBERED_SECONDS = 7 * 24 * 3600
"""How long it is remembered which rows died, so that a service need not read a whole map again."""

ORPHANS_AT_ONCE = 1000

_D, _R, _K = DESCRIPTORS.c, DEAD_ROWS.c, DEAD_KEYS.c
_OF_MAP = _D.map == bindparam("map")

_PUT = Statement(
    lambda insert: insert(DESCRIPTORS).values(
        {name: bindparam(name) for name in ("map", "row", "descriptor", "local", "code")}
    )
)
_DESCRIPTORS_AT = Statement(select(_D.row, _D.descriptor).where(_OF_MAP, among(_D.row, "rows")))
_LOCALS_AT = Statement(select(_D.row, _D.local).where(_OF_MAP, among(_D.row, "rows")))
_BOTH_AT = Statement(select(_D.row, _D.descriptor, _D.local).where(_OF_MAP, among(_D.row, "rows")))
_CODES_AT = Statement(select(_D.row, _D.code).where(_OF_MAP, among(_D.row, "rows")))
_ALL_CODES = Statement(select(_D.row, _D.code).where(_OF_MAP).order_by(_D.row))
_PUT_CODE = Statement(
    update(DESCRIPTORS).where(_OF_MAP, _D.row == bindparam("which")).values(code=bindparam("new_code"))
)
_DEAD_SINCE = Statement(select(_R.row).where(_R.map == bindparam("map"), _R.revision > bindparam("after")))
_NOTE_REVISION = Statement(
    lambda insert: insert(REVISIONS).values(
        {name: bindparam(name) for name in ("map", "revision", "stamp")} | {"since": seconds_now()}
    )
)
_STAMP_OF = Statement(
    select(REVISIONS.c.stamp).where(REVISIONS.c.map == bindparam("map"), REVISIONS.c.revision == bindparam("revision"))
)
_FORGET_REVISIONS = Statement(
    delete(REVISIONS).where(REVISIONS.c.map == bindparam("map"), REVISIONS.c.since < seconds_now() - bindparam("age"))
)
_DELETE_AT = Statement(delete(DESCRIPTORS).where(_OF_MAP, among(_D.row, "rows")))
_ROOM = Statement(
    select(func.coalesce(func.sum(func.octet_length(_D.descriptor) + func.octet_length(_D.local)), 0)).where(_OF_MAP)
)
_LEAVE_ROW = Statement(
    lambda insert: (
        insert(DEAD_ROWS)
        .values({name: bindparam(name) for name in ("map", "row", "revision")} | {"since": seconds_now()})
        .on_conflict_do_nothing()
    )
)
_LEAVE_KEY = Statement(
    lambda insert: (
        insert(DEAD_KEYS)
        .values(map=bindparam("map"), key=bindparam("key"), since=seconds_now())
        .on_conflict_do_nothing()
    )
)
_OLD_ROWS = Statement(
    select(_R.row)
    .where(_R.map == bindparam("map"), _R.cleared == 0, _R.since < seconds_now() - bindparam("age"))
    .order_by(_R.since)
    .limit(ORPHANS_AT_ONCE)
    .with_for_update(skip_locked=True)
)
_UNCLEARED = Statement(select(func.count()).where(_R.map == bindparam("map"), _R.cleared == 0))
_CLEAR_ROWS = Statement(update(DEAD_ROWS).where(_R.map == bindparam("map"), among(_R.row, "rows")).values(cleared=1))
_FORGET_ROWS = Statement(
    delete(DEAD_ROWS).where(_R.map == bindparam("map"), _R.cleared == 1, _R.since < seconds_now() - bindparam("age"))
)
_KEYS = Statement(select(_K.key).where(_K.map == bindparam("map")).order_by(_K.since.desc()).limit(ORPHANS_AT_ONCE))
_OLD_KEYS = Statement(
    select(_K.key)
    .where(_K.map == bindparam("map"), _K.since < seconds_now() - bindparam("age"))
    .order_by(_K.since)
    .limit(ORPHANS_AT_ONCE)
    .with_for_update(skip_locked=True)
)
_CLEAR_KEYS = Statement(delete(DEAD_KEYS).where(among(_K.key, "keys")))
_ALL_KEYS = Statement(
    union(
        select(PLACES.c.key).where(PLACES.c.map == bindparam("map"), PLACES.c.key.is_not(None)),
        select(_K.key).where(_K.map == bindparam("map")),
    )
)
_KNOWN_KEYS = Statement(
    union(select(PLACES.c.key).where(among(PLACES.c.key, "keys")), select(_K.key).where(among(_K.key, "keys")))
)
_NEW_KEY = Statement(select(func.nextval("drawn_keys")))
_LAST_KEY = Statement(select(column("last_value")).select_from(table("drawn_keys")))


# Descriptors


def put_descriptors(
    connection: MapConnection, stored: Mapping[int, tuple[bytes, bytes]], codes: Mapping[int, bytes]
) -> None:
    """Store the descriptors of new rows, and their codes if there are any."""
    values = [
        {"row": row, "descriptor": descriptor, "local": local, "code": codes.get(row)}
        for row, (descriptor, local) in stored.items()
    ]
    if values:
        connection.execute_many(_PUT, values)


def descriptors_at(connection: MapConnection, rows: Sequence[int]) -> dict[int, bytes]:
    """The descriptors of rows; rows that are gone are left out."""
    return dict(connection.execute(_DESCRIPTORS_AT, rows=list(rows)))


def locals_at(connection: MapConnection, rows: Sequence[int]) -> dict[int, bytes]:
    """The local descriptors of rows; rows that are gone are left out."""
    return dict(connection.execute(_LOCALS_AT, rows=list(rows)))


def both_at(connection: MapConnection, rows: Sequence[int]) -> dict[int, tuple[bytes, bytes]]:
    """Both by row; rows that are gone are left out."""
    found = connection.execute(_BOTH_AT, rows=list(rows))
    return {row: (descriptor, local) for row, descriptor, local in found}


def codes_at(connection: MapConnection, rows: Sequence[int]) -> dict[int, bytes | None]:
    """The codes of rows; rows that are gone are left out."""
    return dict(connection.execute(_CODES_AT, rows=list(rows)))


def all_codes(connection: MapConnection, at_once: int) -> Iterator[list[tuple[int, bytes | None]]]:
    """Row and code of all rows, in order, some at a time."""
    return connection.pages(_ALL_CODES, at_once)


def put_codes(connection: MapConnection, codes: Mapping[int, bytes]) -> None:
    """Store codes of rows in the place of those that they have."""
    connection.execute_many(_PUT_CODE, [{"which": row, "new_code": code} for row, code in codes.items()])


def room(connection: MapConnection) -> int:
    """The bytes of descriptors."""
    return int(connection.execute(_ROOM)[0][0])


# Rows that no place has any more


def leave_row(connection: MapConnection, row: int, revision: int) -> None:
    """Note that a row is no place's any more, from a revision of the map on."""
    connection.execute(_LEAVE_ROW, row=row, revision=revision)


def clear_rows(connection: MapConnection) -> int:
    """Delete what is stored of rows that died a while ago; returns how many of them there were."""
    rows = [row for (row,) in connection.execute(_OLD_ROWS, age=LEFT_SECONDS)]
    if rows:
        connection.execute(_DELETE_AT, rows=rows)
        frames.delete_frames(connection, rows)
        connection.execute(_CLEAR_ROWS, rows=rows)
        connection.execute(_FORGET_ROWS, age=REMEMBERED_SECONDS)
        connection.execute(_FORGET_REVISIONS, age=REMEMBERED_SECONDS)
    return len(rows)


def uncleared(connection: MapConnection) -> int:
    """How many rows have died of which something is stored yet."""
    return int(connection.execute(_UNCLEARED)[0][0])


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


# Keys of entities


def new_key(connection: MapConnection) -> int:
    """A number that was never used before."""
    return int(connection.whole.execute(_NEW_KEY)[0][0])


def leave_key(connection: MapConnection, key: int) -> None:
    """Note that an entity is no place's any more."""
    connection.execute(_LEAVE_KEY, key=key)


def dead_keys(connection: MapConnection) -> list[int]:
    """The keys of some entities that are no place's any more, the latest."""
    return [key for (key,) in connection.execute(_KEYS)]


def old_keys(connection: MapConnection) -> list[int]:
    """The keys of some that can be deleted; others, who delete too, get other ones."""
    return [key for (key,) in connection.execute(_OLD_KEYS, age=LEFT_SECONDS)]


def clear_keys(connection: MapConnection, keys: Sequence[int]) -> None:
    """Forget entities, which are deleted."""
    connection.whole.execute(_CLEAR_KEYS, keys=list(keys))


def all_keys(connection: MapConnection) -> list[int]:
    """The keys of all entities of a map, those that are no place's any more included."""
    return [key for (key,) in connection.execute(_ALL_KEYS)]


def known_keys(connection: LedgerConnection, keys: Sequence[int]) -> set[int]:
    """Those of some keys that are a place's, or were one's a while ago."""
    return {key for (key,) in connection.execute(_KNOWN_KEYS, keys=list(keys))}


def last_key(connection: LedgerConnection) -> int:
    """No later key is at most this."""
    return int(connection.execute(_LAST_KEY)[0][0])


# Waiting for others

_SHARE = Statement(
    select(MAPS.c.number).where(MAPS.c.number == bindparam("map")).with_for_update(key_share=True, read=True)
)


def share(connection: MapConnection) -> None:
    """Keep a map from being deleted, and have whoever locks it wait until the transaction ends.

    Raises:
        UnknownMap: it is gone.
    """
    if not connection.execute(_SHARE):
        raise UnknownMap("The map was deleted meanwhile.")


def expect_unpaused(connection: PostgresConnection, map_number: int) -> None:
    """Wait until nobody pauses the writes to a map, and keep others from pausing them until the transaction ends."""
    connection.driver.execute(f"SET LOCAL lock_timeout TO '{WAIT_SECONDS}s'")
    lock = "SELECT pg_advisory_xact_lock_shared(%s::int, %s::int)"
    connection.driver.execute(lock, (WRITING, map_number % 2**31))
