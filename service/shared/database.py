"""Connections to the PostgreSQL that has what services share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from psycopg import Connection

from core.milvus.postgres import Postgres

TABLES = (Path(__file__).parent / "tables.sql").read_text()

MOST_CONNECTIONS = 8

STATEMENT_SECONDS = 10
"""How long a statement may take."""

MAKING_TABLES = 7_061_636_573
"""The lock of whoever makes the tables; any number that nothing else in the database uses."""


def configure(connection: Connection[Any]) -> None:
    """Settings by which a commit is durable, whatever the server's default is, and no statement takes for ever."""
    connection.execute("SET synchronous_commit TO on")
    connection.execute(f"SET statement_timeout TO '{STATEMENT_SECONDS}s'")


def make_tables(connection: Connection[Any]) -> None:
    """Make those that are missing."""
    connection.execute("SELECT pg_advisory_xact_lock(%s)", (MAKING_TABLES,))
    connection.execute(TABLES)


class SharedDatabase(Postgres):
    """The PostgreSQL that has what services share; its tables are made if they are missing."""

    def __init__(self, address: str) -> None:
        super().__init__(address, make_tables, MOST_CONNECTIONS, {"autocommit": True}, configure)

    def execute(self, action: str, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Execute one statement, which is durable when this returns; the rows that it gives.

        Args:
            action: its work, for the message of an error.
        """
        with self.connection(action) as connection:
            cursor = connection.execute(query, values)
            return [] if cursor.description is None else cursor.fetchall()

    @contextmanager
    def transaction(self, action: str, lock: int | None = None) -> Iterator[Connection[Any]]:
        """A transaction that is committed at the end of the block, and undone if it raises.

        Args:
            lock: a number; only one transaction with it runs at a time, over all services.
        """
        with self.connection(action) as connection, connection.transaction():
            if lock is not None:
                connection.execute("SELECT pg_advisory_xact_lock(%s)", (lock,))
            yield connection

    def __enter__(self) -> SharedDatabase:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
