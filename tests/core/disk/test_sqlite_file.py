from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from core.disk.files import Damage
from core.disk.sqlite_file import NotOurs, Schema, SqliteFile, UnreadVersion, connect, expect_writable, transaction
from core.errors import DataDirectoryTooNew, DataDirectoryTooOld

FIRST = Schema(0x74657374, 1, ["CREATE TABLE t (a INTEGER) STRICT"])
SECOND = Schema(0x74657374, 2, ["CREATE TABLE t (a INTEGER, b INTEGER) STRICT"])


def file_of(folder: Path, schema: Schema = SECOND) -> SqliteFile:
    return SqliteFile(folder / "t.sqlite", schema, checks=["SELECT a FROM t"])


def pragma(connection: sqlite3.Connection, name: str) -> object:
    return connection.execute(f"PRAGMA {name}").fetchone()[0]


def test_a_new_file_is_durable_and_says_what_it_is(tmp_path: Path) -> None:
    with closing(file_of(tmp_path).open()) as connection:
        assert (pragma(connection, "journal_mode"), pragma(connection, "synchronous")) == ("wal", 2)
        assert (pragma(connection, "application_id"), pragma(connection, "user_version")) == (0x74657374, 2)
        connection.execute("INSERT INTO t VALUES (1, 2)")
    with closing(file_of(tmp_path).open(create=False)) as connection:
        assert connection.execute("SELECT * FROM t").fetchall() == [(1, 2)]


@pytest.mark.parametrize(
    ("written", "read", "words", "refusal"),
    [
        (SECOND, FIRST, "later version of placerec (schema 2, this one knows 1)", DataDirectoryTooNew),
        (FIRST, SECOND, "before the first release of placerec (schema 1, this one knows 2)", DataDirectoryTooOld),
    ],
)
def test_a_file_of_another_version_is_refused_and_not_touched(
    tmp_path: Path, written: Schema, read: Schema, words: str, refusal: type[Exception]
) -> None:
    with closing(file_of(tmp_path, written).open()) as connection:
        connection.execute("INSERT INTO t (a) VALUES (1)")
    before = (tmp_path / "t.sqlite").read_bytes()
    with pytest.raises(UnreadVersion, match=re.escape(words)) as error:
        file_of(tmp_path, read).open()
    assert error.value.version == written.version
    assert isinstance(error.value.refusal("t"), refusal)
    assert (tmp_path / "t.sqlite").read_bytes() == before


def test_a_file_of_another_version_that_is_replaced_is_put_aside_whole(tmp_path: Path) -> None:
    with closing(file_of(tmp_path, FIRST).open()) as connection:
        connection.execute("INSERT INTO t VALUES (1)")
    before = (tmp_path / "t.sqlite").read_bytes()
    with closing(file_of(tmp_path).open_or_replace()) as connection:
        assert connection.execute("SELECT a, b FROM t").fetchall() == []
    (aside,) = tmp_path.glob("t.sqlite.damaged-*")
    assert aside.read_bytes() == before


def test_tables_that_cannot_be_made_change_nothing(tmp_path: Path) -> None:
    broken = Schema(0x74657374, 1, [*FIRST.create, "SELECT nonsense FROM t"])
    with closing(connect(tmp_path / "t.sqlite", "rwc")) as connection:
        with pytest.raises(sqlite3.OperationalError):
            broken.prepare(connection, create=True)
        assert pragma(connection, "user_version") == 0
        assert connection.execute("SELECT name FROM sqlite_schema").fetchall() == []


def _other_owner(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA application_id = 1")


def _no_version(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA user_version = 0")


def _no_table(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("DROP TABLE t")


def _no_database(path: Path) -> None:
    path.write_bytes(b"this is no database" * 100)


@pytest.mark.parametrize(
    ("damage", "expected"),
    [(_other_owner, NotOurs), (_no_version, NotOurs), (_no_table, Damage), (_no_database, Damage)],
)
def test_a_damaged_file_is_named_as_such_and_can_be_replaced(
    tmp_path: Path, damage: Callable[[Path], None], expected: type[Exception]
) -> None:
    file = file_of(tmp_path)
    file.open().close()
    damage(file.path)
    with pytest.raises(expected):
        file.open()
    with closing(file.open_or_replace()) as connection:
        assert connection.execute("SELECT * FROM t").fetchall() == []
    assert len(list(tmp_path.glob("t.sqlite.damaged-*"))) == 1


def test_a_missing_or_empty_file_is_made_only_where_that_is_asked_for(tmp_path: Path) -> None:
    file = file_of(tmp_path)
    with pytest.raises(sqlite3.OperationalError):
        file.open(create=False)
    assert not file.path.exists()
    file.path.touch()
    with pytest.raises(NotOurs):
        file.open(create=False)
    file.open().close()
    file.open(create=False).close()


def test_a_file_that_cannot_be_written_to_is_no_damage(tmp_path: Path) -> None:
    file = file_of(tmp_path)
    file.open().close()
    with closing(connect(file.path, "ro", {})) as connection, pytest.raises(sqlite3.OperationalError, match="readonly"):
        expect_writable(connection)


def test_a_transaction_is_all_or_nothing(tmp_path: Path) -> None:
    with closing(file_of(tmp_path).open()) as connection:
        with pytest.raises(ZeroDivisionError), transaction(connection):
            connection.execute("INSERT INTO t VALUES (1, 1)")
            1 / 0  # noqa: B018
        assert not connection.in_transaction
        with transaction(connection):
            connection.execute("INSERT INTO t VALUES (2, 2)")
        assert connection.execute("SELECT a FROM t").fetchall() == [(2,)]
