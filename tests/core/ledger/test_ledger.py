"""A ledger does the same in SQLite and in PostgreSQL."""

from __future__ import annotations

import json
import sqlite3
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import Column, Index, MetaData, Table, bindparam, delete, select, update

from core.disk.sqlite_file import DURABLE
from core.errors import DataDirectoryTooNew, DataDirectoryTooOld, StorageFailure, StorageFull, StoreOfAnotherVersion
from core.ledger import Ledger, Statement, Tables
from core.ledger.rows import given_rows
from core.ledger.sqlite import SqliteLedger, file_of
from core.ledger.statements import among, binary, greatest, integer, json_list, real, rounded, seconds_now, text
from tests.core.ledger.conftest import OpenLedger

_METADATA = MetaData()
_FRUIT = Table(
    "fruit",
    _METADATA,
    Column("number", integer(), primary_key=True, autoincrement=True),
    Column("name", text(), nullable=False, unique=True),
    Column("weight", real(), nullable=False),
    Column("picture", binary()),
    Column("at", real()),
    sqlite_strict=True,
    sqlite_autoincrement=True,
)
Index("fruit_by_weight", _FRUIT.c.weight)
TABLES = Tables("fruit", 1, _METADATA, application_id=0x66727569)

_PUT = Statement(
    lambda insert: (
        (put := insert(_FRUIT).values(name=bindparam("name"), weight=bindparam("weight"), picture=bindparam("picture")))
        .on_conflict_do_update(index_elements=["name"], set_={"weight": greatest(_FRUIT.c.weight, put.excluded.weight)})
        .returning(_FRUIT.c.number)
    )
)
_ALL = Statement(select(_FRUIT.c.name, _FRUIT.c.weight).order_by(_FRUIT.c.name))
_NAMED = Statement(select(_FRUIT.c.name).where(among(_FRUIT.c.name, "names")).order_by(_FRUIT.c.number))
_NUMBERED = Statement(select(_FRUIT.c.name).where(among(_FRUIT.c.number, "numbers")))
_TOUCH = Statement(update(_FRUIT).where(_FRUIT.c.name == bindparam("which")).values(at=seconds_now()))
_MOMENT = Statement(select(seconds_now() - _FRUIT.c.at, seconds_now()).where(_FRUIT.c.name == bindparam("name")))
_DELETE = Statement(delete(_FRUIT).where(_FRUIT.c.weight < bindparam("weight")))
_DELETE_NAMED = Statement(delete(_FRUIT).where(_FRUIT.c.name == bindparam("name")))


def _put(ledger: Ledger, name: str, weight: float, picture: bytes | None = None) -> int:
    return int(ledger.execute("put", _PUT, name=name, weight=weight, picture=picture)[0][0])


def test_rows_are_put_replaced_found_and_deleted(open_ledger: OpenLedger) -> None:
    ledger = open_ledger(TABLES)
    first, second = _put(ledger, "pear", 2.5, b"\0pear"), _put(ledger, "Zwetschge", 0.25)
    assert second > first and _put(ledger, "pear", 1.0) == first
    assert ledger.execute("list", _ALL) == [("Zwetschge", 0.25), ("pear", 2.5)]  # by code points, the heavier stays
    assert ledger.execute("list", _NAMED, names=["pear", "plum", "Zwetschge"]) == [("pear",), ("Zwetschge",)]
    assert ledger.execute("list", _NUMBERED, numbers=[second, 77]) == [("Zwetschge",)]
    assert ledger.execute("list", _NAMED, names=[]) == []
    assert ledger.change("delete", _DELETE, weight=1.0) == 1
    assert ledger.change("delete", _DELETE, weight=1.0) == 0
    third = _put(ledger, "plum", 1.0)
    assert third > second  # a number is never used twice


@pytest.mark.parametrize("name", ["pe\0ar", "\ud800", "pear\udfff"])
def test_a_text_that_cannot_be_stored_is_not_found(open_ledger: OpenLedger, name: str) -> None:
    ledger = open_ledger(TABLES)
    _put(ledger, "pear", 1.0)
    for found in (ledger.execute("look", _MOMENT, name=name), ledger.execute("list", _NAMED, names=[name])):
        assert found == []
    assert ledger.execute("list", _NAMED, names=[name, "pear"]) == [("pear",)]
    assert ledger.change("delete", _DELETE_NAMED, name=name) == 0
    with pytest.raises((StorageFailure, UnicodeEncodeError)):
        _put(ledger, "\ud800", 1.0)  # but it is not stored as another one
    assert ledger.execute("list", _ALL) == [("pear", 1.0)]


def test_the_clock_is_that_of_the_database(open_ledger: OpenLedger) -> None:
    ledger = open_ledger(TABLES)
    _put(ledger, "pear", 1)
    assert ledger.change("touch", _TOUCH, which="pear") == 1
    ((idle, now),) = ledger.execute("look", _MOMENT, name="pear")
    assert 0 <= idle < 60 and now > 1_700_000_000


def test_a_transaction_is_kept_whole_or_undone(open_ledger: OpenLedger) -> None:
    ledger = open_ledger(TABLES)
    with ledger.transaction("put two") as connection:
        connection.execute_many(_PUT_MANY, [{"name": name, "weight": 1.0} for name in ("a", "b")])
        assert connection.change(_TOUCH, which="a") == 1
    with pytest.raises(RuntimeError), ledger.transaction("put none") as connection:
        connection.execute(_PUT, name="c", weight=1.0, picture=None)
        raise RuntimeError
    ledger.close()
    assert open_ledger(TABLES).execute("list", _ALL) == [("a", 1.0), ("b", 1.0)]


_PUT_MANY = Statement(lambda insert: insert(_FRUIT).values(name=bindparam("name"), weight=bindparam("weight")))


def test_transactions_of_several_threads_come_one_after_another(open_ledger: OpenLedger) -> None:
    ledger = open_ledger(TABLES)
    _put(ledger, "counter", 0)
    count = Statement(update(_FRUIT).where(_FRUIT.c.name == "counter").values(weight=_FRUIT.c.weight + 1))
    read = Statement(select(_FRUIT.c.weight).where(_FRUIT.c.name == "counter"))
    seen: list[float] = []

    def add() -> None:
        for _ in range(20):
            with ledger.transaction("count") as connection:
                connection.change(count)
                seen.extend(weight for (weight,) in connection.execute(read))

    threads = [threading.Thread(target=add) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(seen) == [float(number) for number in range(1, 81)]


def test_tables_of_an_earlier_version_are_brought_up_to_date_and_of_a_later_one_refused(
    open_ledger: OpenLedger,
) -> None:
    ledger = open_ledger(TABLES)
    _put(ledger, "pear", 1)
    ledger.close()
    add = {"sqlite": ["ALTER TABLE fruit ADD COLUMN colour TEXT"], "postgresql": ["ALTER TABLE fruit ADD colour text"]}
    metadata = MetaData()
    coloured = Table("fruit", metadata, *(column._copy() for column in _FRUIT.columns), Column("colour", text()))
    later = Tables("fruit", 2, metadata, TABLES.application_id, migrations={1: add})  # type: ignore[dict-item]
    paint = Statement(update(coloured).values(colour=bindparam("colour")))
    ledger = open_ledger(later)
    assert ledger.change("paint", paint, colour="green") == 1
    ledger.close()
    with pytest.raises((DataDirectoryTooNew, StoreOfAnotherVersion)):
        open_ledger(TABLES).execute("list", _ALL)
    with pytest.raises((DataDirectoryTooOld, StoreOfAnotherVersion)):
        open_ledger(replace(later, version=9, migrations={})).execute("list", _ALL)
    assert open_ledger(later).execute("list", _ALL) == [("pear", 1.0)]


def test_sqlite_receives_explicit_transactions_that_are_synced(tmp_path: Path) -> None:
    connection = file_of(tmp_path / "fruit.sqlite", TABLES, DURABLE).open()
    received: list[str] = []
    connection.set_trace_callback(received.append)
    ledger = SqliteLedger(connection, "fruit.sqlite")
    with ledger.transaction("put") as writing:
        writing.execute(_PUT, name="pear", weight=1.0, picture=None)
    assert [line.split()[0] for line in received] == ["BEGIN", "INSERT", "COMMIT"]
    assert received[0] == "BEGIN IMMEDIATE"
    received.clear()
    with pytest.raises(RuntimeError), ledger.transaction("put") as writing:
        writing.execute(_PUT, name="plum", weight=1.0, picture=None)
        raise RuntimeError
    assert [line.split()[0] for line in received] == ["BEGIN", "INSERT", "ROLLBACK"]
    received.clear()
    ledger.execute("list", _ALL)  # a statement alone begins no transaction
    assert [line.split()[0] for line in received] == ["SELECT"]
    assert connection.execute("PRAGMA synchronous").fetchone() == (2,)  # FULL
    assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    ledger.close()


def test_a_full_disk_is_named(tmp_path: Path) -> None:
    ledger = SqliteLedger.open(file_of(tmp_path / "fruit.sqlite", TABLES))
    ledger._connection.driver.execute("PRAGMA max_page_count = 8")
    with pytest.raises(StorageFull, match="could not put"):
        for number in range(100):
            _put(ledger, f"fruit {number}", 1, bytes(4096))
    ledger.close()


def test_a_parameter_without_a_value_is_a_defect(open_ledger: OpenLedger) -> None:
    ledger = open_ledger(TABLES)
    with pytest.raises((KeyError, StorageFailure, sqlite3.ProgrammingError)):
        ledger.execute("put", _PUT, name="pear")


def test_many_rows_are_one_parameter(open_ledger: OpenLedger) -> None:
    columns = [_FRUIT.c.name, _FRUIT.c.weight, _FRUIT.c.at]
    put = Statement(
        lambda insert: (
            (many := insert(_FRUIT).from_select([column.name for column in columns], given_rows("fruit", columns)))
            .on_conflict_do_update(index_elements=["name"], set_={"weight": _FRUIT.c.weight + many.excluded.weight})
        )
    )  # fmt: skip
    read = Statement(select(*columns).order_by(_FRUIT.c.name))
    ledger = open_ledger(TABLES)
    basket = [('Äpfel; "rot" \'', 0.1, 3.5), ("pear", 2, None)]
    ledger.execute("put", put, fruit=json.dumps(basket))
    ledger.execute("put", put, fruit=json.dumps([]))
    ledger.execute("put", put, fruit=json.dumps([("pear", 0.5, 9.0)]))
    assert sorted(ledger.execute("list", read)) == sorted([basket[0], ("pear", 2.5, None)])


def test_values_are_rounded_and_listed_as_json(open_ledger: OpenLedger) -> None:
    ledger = open_ledger(TABLES)
    columns = select(_FRUIT.c.name, rounded(_FRUIT.c.weight, 3).label("weight"), _FRUIT.c.at)
    of = columns.where(_FRUIT.c.weight < bindparam("most")).order_by(_FRUIT.c.number).subquery().c
    listed = Statement(select(json_list(of.name), json_list(of.weight), json_list(of.at)))
    assert ledger.execute("list", listed, most=9) == [("[]", "[]", "[]")]
    for name, weight in (("pear", 1.23456), ('Birne "grün"', -2.0), ("plum", 1e9), ("tiny", 0.00049)):
        _put(ledger, name, weight)
    ((names, weights, moments),) = ledger.execute("list", listed, most=2e9)
    assert json.loads(names) == ["pear", 'Birne "grün"', "plum", "tiny"]
    assert json.loads(weights) == [1.235, -2.0, 1e9, 0.0]
    assert json.loads(moments) == [None] * 4
