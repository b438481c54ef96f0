"""A map's record and counters: the row of the table ``maps``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from sqlalchemy import bindparam, delete, func, select, update

from core.errors import MapExists, UnknownMap
from core.ledger.database import LedgerConnection
from core.ledger.maps.checksums import DamagedRow, is_sound, sealed
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import MAPS, PLACES, SEQUENCES
from core.ledger.statements import Statement, seconds_now
from core.maps.records import MapRecord, validation_message
from core.places import NO_SEQUENCE


@dataclass(frozen=True)
class MapState:
    """The state of a map without its places.

    number: never used for another map, also of the same id; 1 in a file.
    places, looks: how many places there are, and how many looks they have besides their first ones.
    rows: all their rows are below it.
    numbers: the number of the next place.
    revision, stamp: the number of the last write, and a text that it drew at random, by which a revision that was lost
        and made again is told from the first one.
    posed: the number of a place that got a pose while the map was open, and may have it still; 0: none is known.
    recall: of the codes, as it was last measured, in JSON; None: it was not.
    """

    number: int
    record: MapRecord
    places: int = 0
    rows: int = 0
    numbers: int = 1
    revision: int = 0
    stamp: str = ""
    looks: int = 0
    recall: str | None = None
    posed: int = 0

    @property
    def searched(self) -> int:
        """How many frames are searched: the places and their looks."""
        return self.places + self.looks


_SEALED = ("record",)  # the counters change with every write, and are compared with the places
_COUNTERS = ("places", "rows", "numbers", "revision", "stamp", "looks", "recall")
_STATE = (
    MAPS.c.number, MAPS.c.id, MAPS.c.listed, MAPS.c.record, MAPS.c.seal, *(MAPS.c[name] for name in _COUNTERS)
)  # fmt: skip

_CREATE = Statement(
    lambda insert: (
        insert(MAPS)
        .values({name: bindparam(name) for name in ("id", "record", "listed", "seal")} | {"touched": seconds_now()})
        .on_conflict_do_nothing()
        .returning(MAPS.c.number)
    )
)
_CREATE_SEQUENCE = Statement(lambda insert: insert(SEQUENCES).values(map=bindparam("map"), code=NO_SEQUENCE))
_OF_NUMBER = Statement(select(*_STATE).where(MAPS.c.number == bindparam("map")))
_OF_NUMBER_LOCKED = Statement(select(*_STATE).where(MAPS.c.number == bindparam("map")).with_for_update())
_LISTED = Statement(select(*_STATE).where(MAPS.c.id == bindparam("id"), MAPS.c.listed == 1))
_NUMBER_OF = Statement(select(MAPS.c.number).where(MAPS.c.id == bindparam("id")))
_IS_LISTED = Statement(select(MAPS.c.listed).where(MAPS.c.id == bindparam("id")))
_RECORDS = Statement(
    select(*_STATE)
    .where(MAPS.c.id > bindparam("after"), MAPS.c.listed == 1)
    .order_by(MAPS.c.id)
    .limit(bindparam("most"))
)
_UNLISTED = Statement(
    select(MAPS.c.id, MAPS.c.number).where(
        MAPS.c.listed == 0, MAPS.c.touched <= seconds_now() - bindparam("untouched_seconds")
    )
)
_PUBLISH = Statement(
    update(MAPS).where(MAPS.c.number == bindparam("map"), MAPS.c.listed == 0).values(id=bindparam("new_id"), listed=1)
)
_UPDATE = Statement(
    update(MAPS)
    .where(MAPS.c.number == bindparam("map"))
    .values({name: bindparam(f"new_{name}") for name in ("record", "seal")})
)
_COUNT = Statement(
    update(MAPS)
    .where(MAPS.c.number == bindparam("map"))
    .values({name: bindparam(f"new_{name}") for name in _COUNTERS} | {"touched": seconds_now()})
)
_HIGHEST = Statement(
    select(
        MAPS.c.numbers, MAPS.c.codes, MAPS.c.revision,
        *(
            select(func.coalesce(func.max(column), -1)).where(column.table.c.map == bindparam("map")).scalar_subquery()
            for column in (PLACES.c.number, SEQUENCES.c.code, PLACES.c.track, PLACES.c.revision)
        ),
    ).where(MAPS.c.number == bindparam("map"))
)  # fmt: skip
_DELETE = Statement(delete(MAPS).where(MAPS.c.number == bindparam("map")))


def create(connection: LedgerConnection, record: MapRecord, name: str | None = None, listed: bool = True) -> int:
    """Insert a map without places; returns its number.

    Args:
        name: the id that it has until it is published; None: its own.

    Raises:
        MapExists: the id is taken.
    """
    values = sealed(_SEALED, {"record": record.model_dump_json()})
    made = connection.execute(_CREATE, id=name or record.id, **values, listed=int(listed))
    if not made:
        raise taken(connection, name or record.id)
    number = int(made[0][0])
    connection.execute(_CREATE_SEQUENCE, map=number)
    return number


def taken(connection: LedgerConnection, map_id: str) -> MapExists:
    """The error for an id that a map has."""
    found = connection.execute(_IS_LISTED, id=map_id)
    listed = not found or found[0][0]
    return MapExists(f"There is already a map {map_id!r}." if listed else f"A map {map_id!r} is being made.")


def is_taken(connection: LedgerConnection, map_id: str) -> bool:
    """Whether a map has this id, or is being built to have it."""
    return bool(connection.execute(_IS_LISTED, id=map_id))


def publish(connection: LedgerConnection, map_number: int, map_id: str) -> None:
    """List a map that was being built, under its id.

    Raises:
        UnknownMap: it is gone, or listed already.
        MapExists: another map has the id.
    """
    for (holder,) in connection.execute(_NUMBER_OF, id=map_id):
        if holder != map_number:
            raise taken(connection, map_id)
    if not connection.change(_PUBLISH, map=map_number, new_id=map_id):
        raise UnknownMap(f"No map {map_id[:80]!r} is being made.")


def unlisted(connection: LedgerConnection, untouched_seconds: float = 0) -> dict[str, int]:
    """The numbers of the maps that are being built, by the ids that they have meanwhile.

    Args:
        untouched_seconds: only those without a write for this time.
    """
    return dict(connection.execute(_UNLISTED, untouched_seconds=untouched_seconds))


def find(connection: LedgerConnection, map_id: str) -> MapState:
    """The listed map of an id.

    Raises:
        UnknownMap: there is none.
        DamagedRow: its row does not match its checksum, or is invalid.
    """
    return _expect(connection.execute(_LISTED, id=map_id), map_id)


def state_of(connection: MapConnection, map_id: str, locked: bool = False) -> MapState:
    """The state of the map of a connection, listed or not.

    Args:
        map_id: for the message.
        locked: whether to keep others from writing to it until the transaction ends.

    Raises:
        UnknownMap: it is gone.
        DamagedRow: its row does not match its checksum, or is invalid, or is missing in a file, which has one map.
    """
    found = connection.execute(_OF_NUMBER_LOCKED if locked else _OF_NUMBER)
    if not found and connection.whole.dialect == "sqlite":
        raise DamagedRow("the map's own record is missing")
    return _expect(found, map_id)


def _expect(found: list[tuple[Any, ...]], map_id: str) -> MapState:
    if not found:
        raise UnknownMap(f"There is no map {map_id[:80]!r}.")
    return _state(found[0])


def _state(values: tuple[Any, ...]) -> MapState:
    number, map_id, listed, text, seal, *counters = values
    if not is_sound((text,), seal):
        raise DamagedRow("the map's own record cannot be read: it does not match its checksum")
    try:
        record = _record(text)
    except ValueError as error:
        raise DamagedRow(f"the map's own record cannot be read: {validation_message(error)}") from error
    if listed and map_id != record.id:
        raise DamagedRow(f"the map's own record cannot be read: it is that of {record.id!r}, not of {map_id!r}")
    return MapState(number, record, *counters)


@lru_cache(1000)
def _record(text: str) -> MapRecord:
    return MapRecord.model_validate_json(text)


def records_after(connection: LedgerConnection, after: str, limit: int) -> list[MapRecord]:
    """Up to ``limit`` records of listed maps by id."""
    return [_state(values).record for values in connection.execute(_RECORDS, after=after, most=limit)]


def put_counters(connection: MapConnection, state: MapState) -> None:
    """Store the counters of a map, as every write to it does."""
    connection.change(_COUNT, **{f"new_{one}": getattr(state, one) for one in _COUNTERS})


def wrong_counters(connection: MapConnection) -> list[str]:
    """The counters of a map that would give a number or a code out a second time."""
    found = connection.one(_HIGHEST)
    if found is None:
        return []
    numbers, codes, revision, number, code, track, changed = found
    wrong = {
        f"the next number of a place, {numbers}, is not above those there are": numbers <= number,
        f"the next code of a sequence, {codes}, is not above those there are": codes <= max(code, track),
        f"the revision, {revision}, is below those of places": revision < changed,
    }
    return [problem for problem, is_wrong in wrong.items() if is_wrong]


def put_record(connection: MapConnection, record: MapRecord) -> None:
    """Store the record of a map."""
    values = sealed(_SEALED, {"record": record.model_dump_json()})
    connection.change(_UPDATE, new_record=values["record"], new_seal=values["seal"])


def delete_map(connection: MapConnection) -> None:
    """Delete a map with all that belongs to it."""
    connection.change(_DELETE)
