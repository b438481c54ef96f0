"""Connections to the PostgreSQL that has what services share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from psycopg import Connection
from psycopg_pool import ConnectionPool, PoolTimeout

from core.errors import StorageFailure
from core.milvus.ledger import postgres_errors

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
    "connect_timeout": 5,
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
    """The PostgreSQL that has what services share; its tables are made if they are missing.  Any thread may use it.

    Every method may raise StorageFull or StorageFailure: PostgreSQL cannot be reached, or refuses.

    Args:
        address: as libpq takes it, such as ``postgresql://placerec@db/placerec``.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self._pool = ConnectionPool(
            address, min_size=1, max_size=MOST_CONNECTIONS, timeout=PATIENCE_SECONDS, kwargs=SETTINGS,
            configure=configure, check=ConnectionPool.check_connection, open=True,
        )  # fmt: skip
        try:
            with self.transaction("make its tables", MAKING_TABLES) as connection:
                connection.execute(TABLES)
        except BaseException:
            self.close()
            raise

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
        try:
            with postgres_errors(action), self._pool.connection() as connection:
                yield connection
        except PoolTimeout as error:
            raise StorageFailure("PostgreSQL cannot be reached.") from error

    def close(self) -> None:
        """Close all connections."""
        self._pool.close()
