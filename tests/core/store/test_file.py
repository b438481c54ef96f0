"""The file of a map: its connections, its tables, and what happens to them when it is closed."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from core.disk.files import Damage
from core.errors import DataDirectoryTooNew, DataDirectoryTooOld, StorageFailure
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import METADATA, TABLES
from core.ledger.sqlite import SqliteConnection
from core.maps.records import MapRecord
from core.store.database import Closed
from core.store.file import MapFile, OpenFiles, create
from tests.core.store.edits import edit
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    create(tmp_path / "lab", MapRecord.new("lab", ENCODER, DIMENSION, LOCAL_SHAPE, "half", None))
    return tmp_path / "lab"


@pytest.fixture
def file(folder: Path) -> Iterator[MapFile]:
    file = MapFile(folder, OpenFiles(2))
    yield file
    file.close()


def driver_of(connection: MapConnection) -> sqlite3.Connection:
    assert isinstance(connection.whole, SqliteConnection)
    return connection.whole.driver


def count(connection: MapConnection) -> int:
    return int(driver_of(connection).execute("SELECT count(*) FROM cameras").fetchone()[0])


def add(connection: MapConnection) -> None:
    driver_of(connection).execute("INSERT INTO cameras (map, name, updated_at, seal) VALUES (1, 'front', 'now', 0)")


def test_a_new_file_has_the_tables_and_the_settings_that_durability_needs(file: MapFile, folder: Path) -> None:
    assert [path.name for path in folder.iterdir()] == ["map.sqlite"] and (folder.stat().st_mode & 0o777) == 0o700
    with file.writing() as writer, file.reading() as reader:
        for one in (writer, reader):
            settings = {"journal_mode": "wal", "synchronous": 2, "secure_delete": 1, "user_version": TABLES.version}
            for name, value in settings.items():
                assert driver_of(one).execute(f"PRAGMA {name}").fetchone() == (value,)
        schema = driver_of(reader).execute("SELECT type, name FROM sqlite_schema").fetchall()
        known = {name for (name,) in driver_of(reader).execute("SELECT idx FROM sqlite_stat1")}
    tables, indexes = ({name for kind, name in schema if kind == wanted} for wanted in ("table", "index"))
    assert tables == {*METADATA.tables, "sqlite_stat1"} and known <= tables | indexes
    assert not [name for kind, name in schema if kind == "trigger"]


def test_a_missing_file_is_not_made(tmp_path: Path) -> None:
    (tmp_path / "hall").mkdir()
    with pytest.raises(Damage, match="is missing"):
        MapFile(tmp_path / "hall", OpenFiles(2)).state()
    with pytest.raises(StorageFailure):  # a disk that may come back
        MapFile(tmp_path / "absent", OpenFiles(2)).state()
    assert list(tmp_path.rglob("*.sqlite*")) == []


def test_all_or_nothing(file: MapFile) -> None:
    with pytest.raises(ZeroDivisionError), file.writing() as connection:
        add(connection)
        1 / 0  # noqa: B018
    with file.reading() as connection:
        assert count(connection) == 0
    with file.writing() as connection:
        add(connection)
    with file.reading() as connection:
        assert count(connection) == 1


def test_readers_do_not_wait_for_a_writer_and_see_the_last_commit(file: MapFile) -> None:
    with file.writing() as writer:
        add(writer)
        with file.reading() as reader:
            assert count(reader) == 0
    with file.reading() as reader:
        assert count(reader) == 1


def test_connections_are_used_again_unless_left_in_a_transaction(file: MapFile) -> None:
    with file.reading() as first, file.reading() as second:
        used = [driver_of(first), driver_of(second)]
        assert used[0] is not used[1]
    with file.glancing() as connection:
        again = driver_of(connection)
        assert again in used
        again.execute("BEGIN")
    with file.reading() as third:
        assert driver_of(third) is not again


def test_closing_waits_for_reads_under_way_refuses_others_and_leaves_one_file(file: MapFile, folder: Path) -> None:
    entered, leave, closed = threading.Event(), threading.Event(), threading.Event()
    counts: list[int] = []
    with file.writing() as connection:
        add(connection)

    def read() -> None:
        with file.reading() as connection:
            entered.set()
            leave.wait(10)
            counts.append(count(connection))

    def close() -> None:
        file.close()
        closed.set()

    threads = [threading.Thread(target=read), threading.Thread(target=close)]
    threads[0].start()
    assert entered.wait(10)
    threads[1].start()
    with pytest.raises(Closed):
        while True:  # until the other thread has begun to close it
            with file.reading():
                pass
    assert not closed.is_set()
    leave.set()
    for thread in threads:
        thread.join(10)
    assert closed.is_set() and counts == [1]
    with pytest.raises(Closed), file.writing():
        pass
    assert [found.name for found in folder.iterdir()] == ["map.sqlite"]


def test_a_file_rests_unless_it_is_in_use(file: MapFile, folder: Path) -> None:
    with file.writing() as connection:
        add(connection)
        assert not file.rest()
    with file.reading():
        assert not file.rest()
    assert file.rest() and [found.name for found in folder.iterdir()] == ["map.sqlite"]
    with file.reading() as connection:
        assert count(connection) == 1


@pytest.mark.parametrize(
    ("statements", "refusal", "words"),
    [
        (["PRAGMA application_id = 1"], Damage, "is not one of placerec's"),
        (["ALTER TABLE places DROP COLUMN regions"], Damage, "lacks regions of its table 'places'"),
        (["ALTER TABLE maps DROP COLUMN codes"], Damage, "lacks codes of its table 'maps'"),
        (["DROP TABLE tokens"], Damage, "of its table 'tokens'"),
        ([f"PRAGMA user_version = {TABLES.version ^ 4}"], Damage, "its tables are of this one"),
        ([f"PRAGMA user_version = {TABLES.version ^ 64}"], Damage, "its tables are of this one"),
        (
            ["ALTER TABLE places ADD COLUMN floor INTEGER", f"PRAGMA user_version = {TABLES.version + 1}"],
            DataDirectoryTooNew,
            "was written by a later version",
        ),
        (
            ["ALTER TABLE descriptors RENAME TO segments", f"PRAGMA user_version = {TABLES.version - 1}"],
            DataDirectoryTooOld,
            "and is left as it is",
        ),
    ],
)
def test_tables_that_are_not_those_of_a_map_are_refused_and_not_touched(
    folder: Path, statements: list[str], refusal: type[Exception], words: str
) -> None:
    edit(folder, *statements)
    with closing(sqlite3.connect(folder / "map.sqlite")) as connection:
        before = list(connection.iterdump())
    with pytest.raises(refusal, match=words):
        MapFile(folder, OpenFiles(2)).state()
    with closing(sqlite3.connect(folder / "map.sqlite")) as connection:
        assert list(connection.iterdump()) == before
