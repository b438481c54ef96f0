"""Connections to PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from psycopg import Connection
from psycopg_pool import ConnectionPool, PoolTimeout

from core.errors import StorageFailure
from core.milvus.ledger import TABLES, postgres_errors

MOST_CONNECTIONS = 8
_PATIENCE_SECONDS = 10.0
_LOCK = 7_061_636_572  # any number that nothing else in the database uses


class Database:
    """The PostgreSQL that has the maps; its tables are made if they are missing.  Any thread may use it.

    Raises:
        StorageFailure: it cannot be reached, or refuses.
    """

    def __init__(self, address: str) -> None:
        """Args: address: as libpq takes it, such as ``postgresql://placerec@db/placerec``."""
        settings = {"application_name": "placerec"}
        self._pool = ConnectionPool(
            address, min_size=1, max_size=MOST_CONNECTIONS, timeout=_PATIENCE_SECONDS, kwargs=settings, open=True
        )
        try:
            with self.transaction("make its tables") as connection:
                connection.execute("SELECT pg_advisory_xact_lock(%s)", (_LOCK,))
                connection.execute(TABLES)
        except BaseException:
            self.close()
            raise

    @contextmanager
    def transaction(self, action: str) -> Iterator[Connection[Any]]:
        """A transaction that is committed at the end of the block, and undone if it raises.

        It is durable when the block has ended, whatever the server's default for that is.

        Raises:
            StorageFull, StorageFailure: PostgreSQL refuses.
        """
        try:
            with postgres_errors(action), self._pool.connection() as connection:
                connection.execute("SET LOCAL synchronous_commit TO on")
                yield connection
        except PoolTimeout as error:
            raise StorageFailure("PostgreSQL cannot be reached.") from error

    @contextmanager
    def reading(self) -> Iterator[Connection[Any]]:
        """A transaction that sees the moment of its first statement."""
        with self.transaction("read") as connection:
            connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ READ ONLY")
            yield connection

    def close(self) -> None:
        """Close all connections."""
        self._pool.close()
