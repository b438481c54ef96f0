from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import replace

import pytest
from core.storage.database.schema import SCHEMA, check_schema, prepare

from core.disk.files import Damage
from core.errors import DataDirectoryTooNew, DataDirectoryTooOld
from core.ledger.maps.schema import METADATA


@pytest.fixture
def connection() -> Iterator[sqlite3.Connection]:
    connection = sqlite3.connect(":memory:", isolation_level=None)
    yield connection
    connection.close()


def version(connection: sqlite3.Connection) -> int:
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


def test_an_empty_file_gets_the_tables(connection: sqlite3.Connection) -> None:
    prepare(connection, create=True)
    assert version(connection) == SCHEMA.version == 13
    check_schema(connection)
    prepare(connection)
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")}
    assert tables == {*METADATA.tables, "segments", "layout", "sqlite_stat1"}
    assert connection.execute("SELECT count(*) FROM sqlite_schema WHERE type = 'trigger'").fetchone() == (0,)
    indexes = {name for table in tables for _, name, *_ in connection.execute(f"PRAGMA index_list({table})")}
    known = {name for (name,) in connection.execute("SELECT idx FROM sqlite_stat1")}
    assert known and known <= indexes | tables and "places_by_revision" not in indexes


def test_tables_that_cannot_be_made_leave_the_file_empty(connection: sqlite3.Connection) -> None:
    with pytest.raises(sqlite3.OperationalError):
        replace(SCHEMA, create=[*SCHEMA.create, "SELECT nonsense"]).prepare(connection, create=True)
    assert version(connection) == 0
    assert connection.execute("SELECT count(*) FROM sqlite_schema").fetchone() == (0,)
    assert not connection.in_transaction


def test_a_later_file_is_refused_and_not_touched(connection: sqlite3.Connection) -> None:
    prepare(connection, create=True)
    connection.execute("ALTER TABLE places ADD COLUMN floor INTEGER NOT NULL DEFAULT 0")
    connection.execute(f"PRAGMA user_version = {SCHEMA.version + 1}")
    with pytest.raises(DataDirectoryTooNew):
        prepare(connection)
    assert version(connection) == SCHEMA.version + 1


@pytest.mark.parametrize("older", range(1, 12))
def test_an_older_file_is_refused_and_not_touched(connection: sqlite3.Connection, older: int) -> None:
    prepare(connection, create=True)
    connection.execute("ALTER TABLE segments DROP COLUMN removed")
    connection.execute(f"PRAGMA user_version = {older}")
    before = list(connection.iterdump())
    with pytest.raises(DataDirectoryTooOld) as error:
        prepare(connection, "maps/lab/map.sqlite")
    assert str(error.value) == (
        f"maps/lab/map.sqlite was written before the first release of placerec (schema {older}, this one knows 13) and "
        "is left as it is: enrol again in a new data directory, or go on with the version that wrote it."
    )
    assert (version(connection), list(connection.iterdump())) == (older, before)


def test_a_file_of_1_0_gets_what_it_lacks(connection: sqlite3.Connection) -> None:
    prepare(connection, create=True)
    for column in ("level", "accuracy_metres", "accuracy_degrees"):
        connection.execute(f"ALTER TABLE places DROP COLUMN {column}")
    connection.execute("PRAGMA user_version = 12")
    with pytest.raises(Damage):
        check_schema(connection)
    prepare(connection)
    assert version(connection) == 13
    check_schema(connection)


def test_what_is_not_ours_is_refused(connection: sqlite3.Connection) -> None:
    with pytest.raises(Damage):
        prepare(connection)  # an empty file, where there should be a map
    connection.execute("CREATE TABLE t (x)")
    with pytest.raises(Damage):
        prepare(connection, create=True)
    connection.execute("PRAGMA user_version = 1")
    with pytest.raises(Damage):
        prepare(connection)


@pytest.mark.parametrize(
    ("statement", "missing"),
    [
        ("ALTER TABLE places DROP COLUMN regions", "lacks regions of its table 'places'"),
        ("ALTER TABLE maps DROP COLUMN codes", "lacks codes of its table 'maps'"),
        ("DROP TABLE segments", "of its table 'segments'"),
        ("DROP TABLE tokens", "of its table 'tokens'"),
    ],
)
def test_a_missing_table_or_column_is_found(connection: sqlite3.Connection, statement: str, missing: str) -> None:
    prepare(connection, create=True)
    connection.execute(statement)
    with pytest.raises(Damage, match=missing):
        check_schema(connection)


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE INDEX places_of_camera ON places (camera)",
        "CREATE TRIGGER no_more AFTER INSERT ON places BEGIN DELETE FROM pictures WHERE row = 0; END",
    ],
)
def test_a_later_file_with_the_same_columns_is_refused_as_such(connection: sqlite3.Connection, statement: str) -> None:
    prepare(connection, create=True)
    connection.execute(statement)
    connection.execute(f"PRAGMA user_version = {SCHEMA.version + 1}")
    with pytest.raises(DataDirectoryTooNew):
        prepare(connection)


@pytest.mark.parametrize("flipped", [4, 64])
def test_a_version_that_is_not_that_of_the_tables_is_damage(connection: sqlite3.Connection, flipped: int) -> None:
    prepare(connection, create=True)
    connection.execute(f"PRAGMA user_version = {SCHEMA.version ^ flipped}")
    with pytest.raises(Damage, match="schema"):
        prepare(connection)
