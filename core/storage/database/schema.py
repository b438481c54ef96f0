"""The tables of ``map.sqlite``: those of any map, and the records of segment files."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from typing import TypeVar

from core.disk.files import Damage
from core.disk.sqlite_file import NotOurs, Schema, UnreadVersion, transaction
from core.ledger import Tables
from core.ledger.maps import places, record, schema, sequences
from core.ledger.maps.connection import MapConnection
from core.ledger.sqlite import SqliteConnection
from core.storage.database.segments import METADATA

T = TypeVar("T")

APPLICATION_ID = 0x504C5243  # "PLRC"

# A file has one map.  Without statistics SQLite takes it that few rows of a table are of the same map, and reads all
# places where it should look up one.  These are of any map; the rows of an index are followed by how many of them have
# the same first column, the same first two, and so on.
_STATISTICS = {
    ("places", "places"): "1000000 1000000 1",
    ("places", "sqlite_autoindex_places_2"): "1000000 1000000 1",  # by id
    ("places", "sqlite_autoindex_places_3"): "1000000 1000000 1",  # by row
    ("places", "places_of_sequence"): "1000000 1000000 5000 1",
    ("places", "places_on_position"): "1000000 1000000 5000 2 1",
    ("places", "looks_of_places"): "1000000 1000000 3",
    ("sequences", "sequences"): "200 200 1",
    ("sequences", "sqlite_autoindex_sequences_2"): "200 200 1",  # by name
    ("tokens", "tokens"): "2000000 2000000 1000 1",
}
_MORE = [
    *Tables("segments", 1, METADATA).create("sqlite"),
    "ANALYZE sqlite_schema",  # makes the table of statistics
    *(
        f"INSERT INTO sqlite_stat1 (tbl, idx, stat) VALUES ('{table}', '{index}', '{numbers}')"
        for (table, index), numbers in _STATISTICS.items()
    ),
]
TABLES = Tables("map", 13, schema.METADATA, APPLICATION_ID, {12: schema.LEVELS}, {"sqlite": _MORE})
SCHEMA = Schema(
    APPLICATION_ID, TABLES.version, TABLES.create("sqlite"), lambda version: TABLES.migrate("sqlite", version)
)


def _columns(connection: sqlite3.Connection) -> dict[str, set[str]]:
    tables = connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table' AND name NOT LIKE 'sqlite_%'")
    return {
        name: {column for (column,) in connection.execute("SELECT name FROM pragma_table_info(?)", (name,))}
        for (name,) in tables.fetchall()
    }


def prepare(connection: sqlite3.Connection, file: str = "map.sqlite", create: bool = False) -> None:
    """See that a file has the tables of a map.

    Args:
        file: its name in a refusal.
        create: make the tables if the file is empty.

    Raises:
        DataDirectoryTooNew: a later version of placerec wrote the file.
        DataDirectoryTooOld: it was written before the first release.
        Damage: it is not the database of a map, or it has these tables and yet another version.
        sqlite3.Error: a statement failed; the file is as it was.
    """
    try:
        SCHEMA.prepare(connection, create)
    except NotOurs as error:
        raise Damage("map.sqlite is not one of placerec's databases") from error
    except UnreadVersion as error:
        if _parts(connection) == _expected(_parts):
            claimed = f"map.sqlite says that it is of schema {error.version}"
            raise Damage(f"{claimed}, but its tables are of {SCHEMA.version}") from error
        raise error.refusal(file) from error


def _parts(connection: sqlite3.Connection) -> tuple[set[tuple[str, str]], dict[str, set[str]]]:
    """The tables and indexes of a file by type and name, and the columns of its tables."""
    query = "SELECT type, name FROM sqlite_schema WHERE name NOT LIKE 'sqlite_%'"
    return set(connection.execute(query)), _columns(connection)


def _expected(read: Callable[[sqlite3.Connection], T]) -> T:
    """The result of ``read`` for a file that has the tables of a map."""
    wanted = sqlite3.connect(":memory:", isolation_level=None)
    try:
        prepare(wanted, create=True)
        return read(wanted)
    finally:
        wanted.close()


def check_schema(connection: sqlite3.Connection) -> None:
    """Check that a file has the tables of a map with their columns.

    Raises:
        Damage: one is missing.
    """
    found = _columns(connection)
    for table, columns in _expected(_columns).items():
        if missing := columns - found.get(table, set()):
            raise Damage(f"map.sqlite lacks {', '.join(sorted(missing))} of its table {table!r}")


def connection_of(connection: sqlite3.Connection) -> MapConnection:
    """The connection to the only map of a file."""
    return MapConnection(SqliteConnection(connection), 1)


def driver_of(connection: MapConnection) -> sqlite3.Connection:
    """SQLite's own connection."""
    assert isinstance(connection.whole, SqliteConnection)
    return connection.whole.driver


def contradictions(connection: MapConnection) -> list[str]:
    """Where the index of metadata, the sequences and the counters contradict the places, some of each kind."""
    return places.stale_tokens(connection) + wrong_references(connection)


def wrong_references(connection: MapConnection) -> list[str]:
    """Where sequences and counters contradict the places."""
    wrong = [f"sequence {name!r} is empty, or ends before its last place" for name in sequences.wrong(connection)]
    lost = [f"place {place_id!r} is of a sequence that is missing" for place_id in sequences.lost(connection)]
    return wrong + lost + record.wrong_counters(connection)


def rebuild_metadata_index(connection: MapConnection) -> None:
    """Rebuild the index of metadata in one transaction.

    Raises:
        sqlite3.Error: the disk refuses; all is as it was.
    """
    with transaction(driver_of(connection)):
        places.rebuild_tokens(connection)
