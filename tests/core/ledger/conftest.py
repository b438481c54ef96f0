"""A ledger in each of the two databases; PostgreSQL where it is installed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from core.disk.sqlite_file import DURABLE
from core.ledger import Ledger, Tables
from core.ledger.postgres import PostgresLedger
from core.ledger.sqlite import SqliteLedger, file_of
from tests.servers.postgres import Postgres

OpenLedger = Callable[[Tables], Ledger]


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def open_ledger(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[OpenLedger]:
    """Opens a ledger with some tables; it has what was written before in the same test."""
    opened: list[Ledger] = []
    address = ""
    if request.param == "postgresql":
        server: Postgres = request.getfixturevalue("postgres")
        address = server.address
        server.empty()

    def made(tables: Tables) -> Ledger:
        ledger: Ledger
        if request.param == "sqlite":
            ledger = SqliteLedger.open(file_of(tmp_path / f"{tables.name}.sqlite", tables, DURABLE))
        else:
            ledger = PostgresLedger(address, [tables])
        opened.append(ledger)
        return ledger

    yield made
    for ledger in opened:
        ledger.close()
