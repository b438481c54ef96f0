"""A ledger that may be lost begins anew when its file turns out to be damaged."""

from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy import Column, MetaData, Table, bindparam, insert, select

from core.errors import StorageFailure
from core.ledger import Statement, Tables
from core.ledger.disposable import DisposableLedger, Replaced, once_more_if_replaced
from core.ledger.sqlite import file_of
from core.ledger.statements import integer

_METADATA = MetaData()
_COUNTS = Table("counts", _METADATA, Column("number", integer(), primary_key=True))
TABLES = Tables("counts", 1, _METADATA)
_ADD = Statement(insert(_COUNTS).values(number=bindparam("number")))
_ALL = Statement(select(_COUNTS.c.number))


def ledger_in(folder: Path) -> DisposableLedger:
    return DisposableLedger(file_of(folder / "counts.sqlite", TABLES, check_whole=False))


def test_the_file_is_opened_when_it_is_first_used(tmp_path: Path) -> None:
    ledger = ledger_in(tmp_path / "later")
    with pytest.raises(StorageFailure):
        ledger.execute("read", _ALL)
    (tmp_path / "later").mkdir()
    assert ledger.change("add", _ADD, number=7) == 1
    ledger.close()
    assert ledger.execute("read", _ALL) == [(7,)], "it opens again"
    ledger.close()


def test_damage_ends_in_a_new_file(tmp_path: Path) -> None:
    ledger = ledger_in(tmp_path)
    ledger.execute("add", _ADD, number=7)
    ledger.close()
    path = tmp_path / "counts.sqlite"
    path.write_bytes(path.read_bytes()[:4096] + b"\xff" * 4096)  # the schema is sound, its table is not
    with pytest.raises(Replaced, match="begins anew"):
        ledger.execute("read", _ALL)
    assert ledger.execute("read", _ALL) == [] and len(list(tmp_path.glob("*.damaged-*"))) == 1
    ledger.close()


def test_work_is_done_again_once_the_file_is_new(tmp_path: Path) -> None:
    ledger = ledger_in(tmp_path)

    @once_more_if_replaced
    def add(number: int) -> None:
        with ledger.transaction("add") as connection:
            if connection.execute(_ALL) == [(7,)]:
                raise ValueError("a value that was never written")
            connection.execute(_ADD, number=number)

    add(7)
    add(8)
    assert ledger.execute("read", _ALL) == [(8,)]
    ledger.close()
