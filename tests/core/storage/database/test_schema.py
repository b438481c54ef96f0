from __future__ import annotations

import sqlite3
from collections.abc import Iterator

import pytest

from core.disk.files import Damage
from core.errors import DataDirectoryTooNew, DataDirectoryTooOld
from core.storage.database import row_checksums
from core.storage.database.schema import FIRST_VERSION, MIGRATIONS, check_schema, migrate

NEWEST = FIRST_VERSION + len(MIGRATIONS)
LATER = (
    *MIGRATIONS,
    ("ALTER TABLE places ADD COLUMN floor INTEGER NOT NULL DEFAULT 0", "CREATE TABLE floors (number INTEGER) STRICT"),
    ("UPDATE places SET floor = 1", "CREATE INDEX places_of_floor ON places (floor)"),
)


@pytest.fixture
def connection() -> Iterator[sqlite3.Connection]:
    connection = sqlite3.connect(":memory:", isolation_level=None)
    yield connection
    connection.close()


def version(connection: sqlite3.Connection) -> int:
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


PLACE = (
    "INSERT INTO places (id, row, checksum, digest, regions, picture, sequence, ordinal, metadata, created_at,"
    " updated_at) VALUES ('p', 0, 1, zeroblob(32), 3, 'none', -1, 0, '{}', 'now', 'now')"
)


def test_an_empty_file_gets_the_newest_schema(connection: sqlite3.Connection) -> None:
    migrate(connection, create=True)
    assert version(connection) == NEWEST
    check_schema(connection)
    assert migrate(connection) == 0


def test_an_older_file_becomes_newer_and_keeps_what_it_holds(connection: sqlite3.Connection) -> None:
    migrate(connection, create=True)
    connection.execute(PLACE)
    assert migrate(connection, LATER) == len(LATER) - len(MIGRATIONS)
    assert version(connection) == FIRST_VERSION + len(LATER)
    assert connection.execute("SELECT id, regions, floor FROM places").fetchall() == [("p", 3, 1)]
    check_schema(connection, LATER)


def test_a_file_of_the_first_release_gets_checksums_of_the_new_columns(connection: sqlite3.Connection) -> None:
    migrate(connection, (), create=True)
    assert version(connection) == FIRST_VERSION
    for number in range(2):
        connection.execute(PLACE.replace("'p', 0", f"'p{number}', {number}"))
    connection.execute("INSERT INTO cameras (name, updated_at) VALUES ('front', 'now')")
    for table in ("places", "cameras"):
        connection.execute(f"UPDATE {table} SET seal = {row_checksums.expression(table, 0)}")
    connection.execute("UPDATE places SET regions = 4 WHERE id = 'p1'")  # the disk flips a bit
    migrate(connection)
    assert row_checksums.mismatched(connection, "places") == ["p1"], "what was damaged is not sealed again"
    assert row_checksums.mismatched(connection, "cameras") == []
    assert connection.execute("SELECT track, station FROM places").fetchall() == [(None, None)] * 2
    for table, column, value in (("places", "station", 3), ("cameras", "intrinsics", "{}")):
        connection.execute(f"UPDATE {table} SET {column} = ?", (value,))
        assert row_checksums.mismatched(connection, table), f"{column} is not covered"


def test_a_migration_that_fails_leaves_the_file_as_it_was(connection: sqlite3.Connection) -> None:
    migrate(connection, create=True)
    before = connection.execute("SELECT sql FROM sqlite_schema").fetchall()
    with pytest.raises(sqlite3.OperationalError):
        migrate(connection, (*LATER, ("SELECT nonsense",)))
    assert version(connection) == NEWEST
    assert connection.execute("SELECT sql FROM sqlite_schema").fetchall() == before
    assert not connection.in_transaction


def test_a_later_file_is_refused_and_not_touched(connection: sqlite3.Connection) -> None:
    migrate(connection, LATER, create=True)
    with pytest.raises(DataDirectoryTooNew):
        migrate(connection)
    assert version(connection) == FIRST_VERSION + len(LATER)


def test_a_file_from_before_the_first_release_is_refused_and_not_touched(connection: sqlite3.Connection) -> None:
    migrate(connection, create=True)
    connection.execute("ALTER TABLE segments DROP COLUMN removed")
    connection.execute("PRAGMA user_version = 6")
    with pytest.raises(DataDirectoryTooOld, match="before the first release of placerec \\(schema 6"):
        migrate(connection)
    assert version(connection) == 6


def test_what_is_not_ours_is_refused(connection: sqlite3.Connection) -> None:
    with pytest.raises(Damage):
        migrate(connection)  # an empty file, where there should be a map
    connection.execute("CREATE TABLE t (x)")
    with pytest.raises(Damage):
        migrate(connection, create=True)
    connection.execute("PRAGMA user_version = 1")
    with pytest.raises(Damage):
        migrate(connection)


def test_a_missing_table_or_column_is_found(connection: sqlite3.Connection) -> None:
    migrate(connection, create=True)
    connection.execute("ALTER TABLE places DROP COLUMN regions")
    with pytest.raises(Damage, match="regions of its table 'places'"):
        check_schema(connection)
    connection.execute("DROP TABLE segments")
    with pytest.raises(Damage, match="segments"):
        check_schema(connection)


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE INDEX places_of_camera ON places (camera)",
        "CREATE TRIGGER no_more AFTER INSERT ON places BEGIN DELETE FROM pictures WHERE place = 0; END",
    ],
)
def test_a_later_file_with_the_same_columns_is_refused_as_such(connection: sqlite3.Connection, statement: str) -> None:
    migrate(connection, (*MIGRATIONS, (statement,)), create=True)
    with pytest.raises(DataDirectoryTooNew):
        migrate(connection)


@pytest.mark.parametrize("flipped", [4, 64])
def test_a_version_that_is_not_that_of_the_tables_is_damage(connection: sqlite3.Connection, flipped: int) -> None:
    migrate(connection, create=True)
    connection.execute(f"PRAGMA user_version = {NEWEST ^ flipped}")
    with pytest.raises(Damage, match="schema"):
        migrate(connection)
