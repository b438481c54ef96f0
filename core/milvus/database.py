"""The PostgreSQL that has the maps."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import psycopg
from psycopg import Connection

from core.errors import StoreOfAnotherVersion
from core.ledger.outage import Unreachable
from core.ledger.postgres import Postgres
from core.milvus.ledger import TABLES, VERSION, version_of

MOST_CONNECTIONS = 16
_LOCK = 7_061_636_572  # any number that nothing else in the database uses


def _make_tables(connection: Connection[Any]) -> None:
    connection.execute("SELECT pg_advisory_xact_lock(%s)", (_LOCK,))
    found = version_of(connection)
    if found is None:
        connection.execute(TABLES)
    elif found != VERSION:
        raise StoreOfAnotherVersion(
            f"The tables in PostgreSQL are those of version {found}, which this placerec does not read; it reads "
            f"version {VERSION}. They are left as they are: go on with the version that made them, or enrol again in "
            "another database."
        )


class Database(Postgres):
    """The PostgreSQL that has the maps; its tables are made if they are missing.

    Every method may also raise StoreOfAnotherVersion: its tables were made by another version.
    """

    def __init__(self, address: str) -> None:
        super().__init__(address, _make_tables, MOST_CONNECTIONS, {})

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
    def locked(
        self, action: str, kind: int, number: int, wait: bool = True, shared: bool = False
    ) -> Iterator[Connection[Any] | None]:
        """Hold a lock of the database on a connection of its own; None if another has it and ``wait`` is not set.

        Others may hold a ``shared`` one as well, if theirs is shared too.

        The block ends its transactions on that connection itself.  The lock is gone when the connection is lost, and
        then the connection takes no further statement.
        """
        key, how = (kind, number % 2**31), "_shared" if shared else ""
        with self.connection(action) as connection:
            if wait:
                connection.execute(f"SELECT pg_advisory_lock{how}(%s::int, %s::int)", key)
            elif connection.execute(f"SELECT pg_try_advisory_lock{how}(%s::int, %s::int)", key).fetchone() != (True,):
                yield None
                return
            connection.commit()
            try:
                yield connection
            finally:
                with suppress(psycopg.Error):  # a lost connection has no lock
                    connection.rollback()
                    connection.execute(f"SELECT pg_advisory_unlock{how}(%s::int, %s::int)", key)
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
