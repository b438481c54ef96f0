"""Connections to the PostgreSQL that has what services share."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psycopg
from psycopg import Connection
from psycopg_pool import ConnectionPool, PoolTimeout

from core.errors import StoreUnavailable
from core.milvus.ledger import postgres_errors
from core.milvus.outage import Outage

TABLES = (Path(__file__).parent / "tables.sql").read_text()

MOST_CONNECTIONS = 8

PATIENCE_SECONDS = 3.0
"""How long a statement waits for a connection; PostgreSQL counts as unreachable then."""

STATEMENT_SECONDS = 10
"""How long a statement may take."""

MAKING_TABLES = 7_061_636_573
"""The lock of whoever makes the tables; any number that nothing else in the database uses."""

SETTINGS: dict[str, Any] = {
    "application_name": "placerec",
    "autocommit": True,
    "connect_timeout": 3,
    # A machine that is gone is noticed within some ten seconds.
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 10_000,
}


def configure(connection: Connection[Any]) -> None:
    """What is committed is durable, whatever the server's default is, and nothing takes for ever."""
    connection.execute("SET synchronous_commit TO on")
    connection.execute(f"SET statement_timeout TO '{STATEMENT_SECONDS}s'")


class SharedDatabase:
    """The PostgreSQL that has what services share.  Any thread may use it.

    It is connected to when it is first used; its tables are made then, if they are missing.  Every method may raise
    StoreUnavailable (it cannot be reached), StorageFull or StorageFailure (it refuses).

    Args:
        address: as libpq takes it, such as ``postgresql://placerec@db/placerec``.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self._outage = Outage("PostgreSQL")
        self._opening = threading.Lock()
        self._pool: ConnectionPool[Connection[Any]] | None = None

    def _opened(self) -> ConnectionPool[Connection[Any]]:
        """The pool of connections to a database whose tables are there."""
        if (pool := self._pool) is not None:
            return pool
        with self._opening:
            if self._pool is None:
                with self._alone() as connection, connection.transaction():
                    connection.execute("SELECT pg_advisory_xact_lock(%s)", (MAKING_TABLES,))
                    connection.execute(TABLES)
                self._pool = ConnectionPool(
                    self.address, min_size=1, max_size=MOST_CONNECTIONS, timeout=PATIENCE_SECONDS, kwargs=SETTINGS,
                    configure=configure, check=ConnectionPool.check_connection, open=True,
                )  # fmt: skip
            return self._pool

    @contextmanager
    def _alone(self) -> Iterator[Connection[Any]]:
        """A connection of its own, which says why there is none."""
        with postgres_errors("make its tables"), psycopg.connect(self.address, **SETTINGS) as connection:
            yield connection

    def execute(self, action: str, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Execute one statement, which is durable when this returns; the rows that it gives.

        Args:
            action: what it does, for the message of an error.
        """
        with self._connected(action) as connection:
            cursor = connection.execute(query, values)
            return [] if cursor.description is None else cursor.fetchall()

    @contextmanager
    def transaction(self, action: str, lock: int | None = None) -> Iterator[Connection[Any]]:
        """A transaction that is committed at the end of the block, and undone if it raises.

        Args:
            lock: a number; only one transaction with it runs at a time, over all services.
        """
        with self._connected(action) as connection, connection.transaction():
            if lock is not None:
                connection.execute("SELECT pg_advisory_xact_lock(%s)", (lock,))
            yield connection

    @contextmanager
    def _connected(self, action: str) -> Iterator[Connection[Any]]:
        with self._outage.noticed():
            pool = self._opened()
            try:
                with postgres_errors(action), pool.connection() as connection:
                    yield connection
            except PoolTimeout as error:
                with self._alone():  # raises if it cannot be reached
                    pass
                raise StoreUnavailable("All connections to PostgreSQL are in use.") from error

    def __enter__(self) -> SharedDatabase:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        with self._opening:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.close()
