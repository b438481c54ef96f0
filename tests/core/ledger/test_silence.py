"""A PostgreSQL that falls silent is given up by the client's own deadline, and used again when it is back."""

from __future__ import annotations

import time

import psycopg
import pytest
from sqlalchemy import Column, MetaData, Table, select

from core.errors import StoreOfAnotherVersion, StoreUnavailable
from core.ledger import Statement, Tables
from core.ledger import postgres as connections
from core.ledger.postgres import PostgresLedger
from core.ledger.statements import text
from tests.servers.postgres import Postgres

pytestmark = [pytest.mark.postgres, pytest.mark.timeout(120)]

_ONE = Statement(select(1))
_METADATA = MetaData()
Table("fruit", _METADATA, Column("name", text(), primary_key=True))


@pytest.mark.thorough
def test_a_server_that_stands_still_is_given_up_soon(postgres: Postgres, monkeypatch: pytest.MonkeyPatch) -> None:
    ledger = PostgresLedger(postgres.address, [])
    assert ledger.execute("look", _ONE) == [(1,)]
    with postgres.server.silenced():
        began = time.monotonic()
        with pytest.raises(StoreUnavailable, match="PostgreSQL"):
            ledger.execute("look", _ONE)
        # It would be 75 s without a deadline of its own; this is no measure of speed.
        assert time.monotonic() - began < 40
        with pytest.raises(StoreUnavailable, match="PostgreSQL"):
            ledger.execute("look", _ONE)
    for _ in range(600):
        try:
            assert ledger.execute("look", _ONE) == [(1,)]
            break
        except StoreUnavailable:
            time.sleep(0.1)
    else:
        pytest.fail("PostgreSQL is back and not used again")
    ledger.close()


def test_a_statement_without_an_answer_ends_its_connection(postgres: Postgres, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "ANSWER_SECONDS", 0.5)
    ledger = PostgresLedger(postgres.address, [])
    with ledger.connection("look", 0.5) as connection:
        with pytest.raises(psycopg.OperationalError, match="does not answer within"):
            connection.execute("SELECT pg_sleep(60)")
        assert connection.closed
    silent = pytest.raises(StoreUnavailable, match="PostgreSQL cannot be reached: it does not answer")
    with silent, ledger.connection("look", 0.5) as connection:
        connection.execute("SELECT pg_sleep(60)")
    ledger.close()


def test_one_who_listens_stays_connected_while_nobody_speaks(postgres: Postgres) -> None:
    ledger = PostgresLedger(postgres.address, [])
    with ledger.listening("placerec_test") as heard:
        for _ in range(3):
            assert list(heard(0.05)) == []
        ledger.notify("speak", "placerec_test", "there")
        assert next(iter(heard(30.0))) == "there"
    ledger.close()


def test_another_programs_tables_are_refused_and_left_alone(postgres: Postgres) -> None:
    postgres.empty()
    ledger = PostgresLedger(postgres.address, [Tables("fruit", 1, _METADATA)])
    with psycopg.connect(postgres.address, autocommit=True) as other:
        other.execute("CREATE TABLE fruit (apple text)")
        with pytest.raises(StoreOfAnotherVersion, match="another program"):
            ledger.check()
        assert other.execute("SELECT to_regclass('placerec_tables')").fetchone() == (None,)
        other.execute("DROP TABLE fruit")
        ledger.check()
    ledger.close()
