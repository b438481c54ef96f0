"""The PostgreSQL that has what services share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from psycopg import Connection

from core.ledger.postgres import PostgresLedger, prepare
from core.ledger.tables import Tables
from service.events import relay
from service.peers import replica
from service.queries import count_tables, recent_answers

TEXT = (Path(__file__).parent / "tables.sql").read_text()

TABLES: Sequence[Tables] = (replica.TABLES, count_tables.TABLES, recent_answers.TABLES, relay.TABLES)
"""The tables of the parts that are written for both databases."""


LIVING = f"SELECT id FROM replicas WHERE seen > extract(epoch FROM clock_timestamp()) - {replica.GONE_SECONDS}"
"""The ids of the services that are there, for statements given as text."""


def make_tables(connection: Connection[Any]) -> None:
    """Make those that are missing."""
    prepare(connection, TABLES)
    connection.execute(TEXT)


class SharedDatabase(PostgresLedger):
    """The PostgreSQL that has what services share; its tables are made if they are missing."""

    def __init__(self, address: str) -> None:
        super().__init__(address, TABLES)
        self._make_tables = make_tables

    def query(self, action: str, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Execute one statement given as text, which is durable when this returns; the rows that it gives.

        Args:
            action: its work, for the message of an error.
        """
        with self.connection(action) as connection:
            cursor = connection.execute(query, values)
            return [] if cursor.description is None else cursor.fetchall()

    @contextmanager
    def text_transaction(self, action: str, lock: int | None = None) -> Iterator[Connection[Any]]:
        """A transaction for statements given as text, as :meth:`transaction`."""
        with self.connection(action) as connection, connection.transaction():
            if lock is not None:
                connection.execute("SELECT pg_advisory_xact_lock(%s)", (lock,))
            yield connection

    def __enter__(self) -> SharedDatabase:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
