"""Connections to PostgreSQL."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import psycopg
from psycopg import Connection
from psycopg_pool import ConnectionPool, PoolTimeout

from core.errors import StoreOfAnotherVersion, StoreUnavailable
from core.milvus.ledger import TABLES, VERSION, postgres_errors, version_of
from core.milvus.outage import Outage, Unreachable

logging.getLogger("psycopg.pool").setLevel(logging.CRITICAL)  # it would log each attempt of an outage

MOST_CONNECTIONS = 16
_PATIENCE_SECONDS = 3.0
_CONNECTING = {"application_name": "placerec", "connect_timeout": 3, "keepalives_idle": 10, "keepalives_interval": 5}
_LOCK = 7_061_636_572  # any number that nothing else in the database uses


class Database:
    """The PostgreSQL that has the maps; its tables are made if they are missing.  Any thread may use it.

    It is connected to when it is first used.
    """

    def __init__(self, address: str) -> None:
        """Args: address: as libpq takes it, such as ``postgresql://placerec@db/placerec``."""
        self._address = address
        self._outage = Outage("PostgreSQL")
        self._making = threading.Lock()
        self._pool: ConnectionPool[Connection[Any]] | None = None

    def _connected(self) -> ConnectionPool[Connection[Any]]:
        """The pool of connections to a database whose tables are there.

        Raises:
            StoreUnavailable: it cannot be reached, or refuses.
            StoreOfAnotherVersion: its tables were made by another version.
            StorageFull, StorageFailure.
        """
        if (pool := self._pool) is not None:
            return pool
        with self._making:
            if self._pool is None:
                with self._connecting() as connection:
                    connection.execute("SELECT pg_advisory_xact_lock(%s)", (_LOCK,))
                    found = version_of(connection)
                    if found is None:
                        connection.execute(TABLES)
                    elif found != VERSION:
                        raise StoreOfAnotherVersion(
                            f"The tables in PostgreSQL are those of version {found}, which this placerec does not "
                            f"read; it reads version {VERSION}."
                        )
                self._pool = ConnectionPool(
                    self._address, min_size=1, max_size=MOST_CONNECTIONS, timeout=_PATIENCE_SECONDS,
                    kwargs=_CONNECTING, check=ConnectionPool.check_connection, open=True,
                )  # fmt: skip
            return self._pool

    @contextmanager
    def _connecting(self) -> Iterator[Connection[Any]]:
        """A connection of its own, which says why there is none."""
        with postgres_errors("make its tables"), psycopg.connect(self._address, **_CONNECTING) as connection:  # type: ignore[arg-type]
            yield connection

    @contextmanager
    def connection(self, action: str) -> Iterator[Connection[Any]]:
        """A connection of the pool; what the block does not commit is undone if it raises, else committed.

        Raises:
            StoreUnavailable, StorageFull, StorageFailure: PostgreSQL cannot be reached, or refuses.
        """
        with self._outage.noticed():
            pool = self._connected()
            try:
                with postgres_errors(action), pool.connection() as connection:
                    yield connection
            except PoolTimeout as error:
                with self._connecting():  # raises if it cannot be reached
                    pass
                raise StoreUnavailable("All connections to PostgreSQL are in use.") from error

    @contextmanager
    def transaction(self, action: str) -> Iterator[Connection[Any]]:
        """A transaction that is committed at the end of the block, and undone if it raises.

        It is durable when the block has ended, whatever the server's default for that is.

        Raises:
            StoreUnavailable, StorageFull, StorageFailure: PostgreSQL cannot be reached, or refuses.
        """
        with self.connection(action) as connection:
            connection.execute("SET LOCAL synchronous_commit TO on")
            yield connection

    @contextmanager
    def reading(self) -> Iterator[Connection[Any]]:
        """A transaction that sees the moment of its first statement."""
        with self.connection("read") as connection:
            connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ READ ONLY")
            yield connection

    @contextmanager
    def locked(self, action: str, kind: int, number: int, wait: bool = True) -> Iterator[Connection[Any] | None]:
        """Hold a lock of the database on a connection of its own; None if another has it and ``wait`` is not set.

        The block ends its transactions on that connection itself.  The lock is gone when the connection is lost, and
        then the connection takes no further statement.
        """
        key = (kind, number % 2**31)
        with self.connection(action) as connection:
            if wait:
                connection.execute("SELECT pg_advisory_lock(%s::int, %s::int)", key)
            elif connection.execute("SELECT pg_try_advisory_lock(%s::int, %s::int)", key).fetchone() != (True,):
                yield None
                return
            connection.commit()
            try:
                yield connection
            finally:
                with suppress(psycopg.Error):  # a lost connection has no lock
                    connection.rollback()
                    connection.execute("SELECT pg_advisory_unlock(%s::int, %s::int)", key)
                    connection.commit()

    def check(self) -> None:
        """Ask it whether it takes writes.

        Raises:
            StoreUnavailable, StoreOfAnotherVersion, StorageFailure: it does not.
        """
        with self.connection("answer") as connection:
            found = connection.execute("SELECT pg_is_in_recovery()").fetchone()
        if found != (False,):
            raise Unreachable("PostgreSQL", "takes no writes: it is a standby.")

    def close(self) -> None:
        """Close all connections."""
        with self._making:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.close()
