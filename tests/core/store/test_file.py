from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from core.storage.database.connections import Database, DatabaseClosed, connect
from core.storage.database.schema import driver_of, prepare

from core.disk.files import Damage
from core.ledger.maps.connection import MapConnection


@pytest.fixture
def path(tmp_path: Path) -> Path:
    connection = connect(tmp_path / "map.sqlite", create=True)
    prepare(connection, create=True)
    connection.close()
    return tmp_path / "map.sqlite"


@pytest.fixture
def database(path: Path) -> Iterator[Database]:
    database = Database(path)
    yield database
    database.close()


def count(connection: MapConnection) -> int:
    return int(driver_of(connection).execute("SELECT count(*) FROM cameras").fetchone()[0])


def add(connection: MapConnection) -> None:
    driver_of(connection).execute("INSERT INTO cameras (map, name, updated_at, seal) VALUES (1, 'front', 'now', 0)")


def test_the_settings_that_durability_needs(database: Database) -> None:
    with database.transaction() as writer, database.reading() as reader:
        for connection in (writer, reader):
            assert driver_of(connection).execute("PRAGMA journal_mode").fetchone() == ("wal",)
            assert driver_of(connection).execute("PRAGMA synchronous").fetchone() == (2,)


def test_a_missing_file_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(sqlite3.OperationalError):
        Database(tmp_path / "absent.sqlite")
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_not_ours(tmp_path: Path) -> None:
    sqlite3.connect(tmp_path / "other.sqlite").execute("CREATE TABLE t (x)").connection.close()
    with pytest.raises(Damage):
        Database(tmp_path / "other.sqlite")


def test_all_or_nothing(database: Database) -> None:
    with pytest.raises(ZeroDivisionError), database.transaction() as connection:
        add(connection)
        1 / 0  # noqa: B018
    with database.reading() as connection:
        assert count(connection) == 0
    with database.transaction() as connection:
        add(connection)
    with database.reading() as connection:
        assert count(connection) == 1


def test_readers_do_not_wait_for_a_writer_and_see_the_last_commit(database: Database) -> None:
    with database.transaction() as writer:
        add(writer)
        with database.reading() as reader:
            assert count(reader) == 0
    with database.reading() as reader:
        assert count(reader) == 1


def test_connections_are_used_again_unless_left_in_a_transaction(database: Database) -> None:
    with database.reading() as first, database.reading() as second:
        used = [driver_of(first), driver_of(second)]
        assert used[0] is not used[1]
    with database.reading() as connection:
        again = driver_of(connection)
        assert again in used
        again.execute("BEGIN")
    with database.reading() as third:
        assert driver_of(third) is not again


def test_closing_waits_for_reads_under_way_and_refuses_others(database: Database) -> None:
    entered, leave, closed = threading.Event(), threading.Event(), threading.Event()
    counts: list[int] = []

    def read() -> None:
        with database.reading() as connection:
            entered.set()
            leave.wait(10)
            counts.append(count(connection))

    def close() -> None:
        database.close()
        closed.set()

    threads = [threading.Thread(target=read), threading.Thread(target=close)]
    threads[0].start()
    assert entered.wait(10)
    threads[1].start()
    with pytest.raises(DatabaseClosed):
        while True:  # until the other thread has begun to close it
            with database.reading():
                pass
    assert not closed.wait(0.1)
    leave.set()
    for thread in threads:
        thread.join(10)
    assert closed.is_set()
    assert counts == [0]
    with pytest.raises(DatabaseClosed), database.transaction():
        pass


def test_the_log_can_be_emptied(database: Database, path: Path) -> None:
    log = path.with_name("map.sqlite-wal")
    with database.transaction() as connection:
        add(connection)
    assert log.stat().st_size > 0
    database.empty_log()
    assert log.stat().st_size == 0
    with database.reading() as connection:
        assert count(connection) == 1


def test_closing_leaves_one_file(database: Database, path: Path) -> None:
    with database.transaction() as connection:
        add(connection)
    database.close()
    assert [found.name for found in path.parent.iterdir()] == ["map.sqlite"]
