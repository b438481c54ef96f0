"""A ledger in a PostgreSQL that may be away, or refuse: connections to it, and what it says as our errors."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Literal

import psycopg
from psycopg import Connection
from psycopg.conninfo import conninfo_to_dict
from psycopg_pool import ConnectionPool, PoolTimeout

from core.errors import StorageFailure, StorageFull, StoreOfAnotherVersion, StoreUnavailable
from core.ledger.database import Lock
from core.ledger.statements import Statement
from core.ledger.tables import Tables
from core.outage import Outage, Unreachable

logging.getLogger("psycopg.pool").setLevel(logging.CRITICAL)  # it would log each attempt of an outage

PATIENCE_SECONDS = 3.0
"""How long a statement waits for a connection; PostgreSQL counts as unreachable then."""

SETTINGS: Mapping[str, Any] = {
    "application_name": "placerec",
    "connect_timeout": 3,
    # A machine that is gone is noticed within some ten seconds.
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 10_000,
}

ANSWER_SECONDS = 10.0
"""How long a statement may take before PostgreSQL counts as silent, and the connection is given up.

This is the client's own deadline: a server whose processes stand still, or a network that swallows packets, ends no
connection by itself for minutes."""

PROBE_SECONDS = 2
"""How long it may take to answer to a connection that has not been used for a while, or after an outage."""

CHECKED_SECONDS = 0.5
"""A connection that has answered within this time is used without a question whether it still does."""

LONG_SECONDS = 600.0
"""The same for statements that may rightly take long: those that wait for a lock, or delete a map."""

# The pool waits twice as long between two attempts each time, up to minutes; after this time it gives up, and the
# next request begins anew.
_RECONNECTING_SECONDS = 1.0


class TimedConnection(Connection[Any]):
    """A connection that is given up when a statement gets no answer in time.

    seconds: how long each statement may take.
    answered: when it answered last, by the monotonic clock.
    """

    seconds = ANSWER_SECONDS
    answered = -math.inf

    def wait(self, gen: Any, interval: float = 0.1, timeout: float | None = None) -> Any:
        """Wait for the answer to a statement; psycopg calls this for each.

        Args:
            timeout: of a caller that knows what to do when it is over, as one that waits for notices; the connection
                stays then.

        Raises:
            psycopg.OperationalError: there is none in time; the connection is closed.
        """
        if timeout is not None:
            return super().wait(gen, interval=interval, timeout=timeout)
        try:
            found = super().wait(gen, interval=interval, timeout=self.seconds)
            self.answered = time.monotonic()
            return found
        except psycopg.errors._WaitTimeout as error:
            self.pgconn.finish()
            raise psycopg.OperationalError(f"it does not answer within {self.seconds:.0f} s") from error


@contextmanager
def postgres_errors(action: str) -> Iterator[None]:
    """Turn the errors of PostgreSQL into our own."""
    try:
        yield
    except psycopg.errors.DiskFull as error:
        raise StorageFull(f"PostgreSQL has no room left to {action}.") from error
    except psycopg.errors.LockNotAvailable as error:
        raise StoreUnavailable(
            f"PostgreSQL refuses to {action}: others are writing to the map for too long."
        ) from error
    except psycopg.errors.InsufficientPrivilege as error:
        text = f"refuses to {action}, for its role has no right to: {_in_one_line(error)}"
        raise Unreachable("PostgreSQL", text) from error
    except (psycopg.OperationalError, psycopg.InterfaceError) as error:
        if isinstance(error, PoolTimeout):
            raise
        said = _in_one_line(error)
        verdict = "cannot be reached"
        if "FATAL" in said or "no password" in said:
            verdict = "refuses the service"
        elif "certificate" in said:
            verdict = "cannot be trusted"
        elif error.sqlstate is not None and not error.sqlstate.startswith("57P"):  # it is shutting down, or starting
            verdict = f"refuses to {action}"
        raise Unreachable("PostgreSQL", f"{verdict}: {said}") from error
    except psycopg.Error as error:
        raise StorageFailure(f"PostgreSQL refuses to {action}: {str(error).strip()[:300]}") from error


def _in_one_line(error: psycopg.Error) -> str:
    said = error.diag.message_primary or str(error)
    return " ".join(said.split())[:300]


def check_address(address: str) -> None:
    """Raise unless libpq reads an address as it was meant.

    Its own errors would show parts of a password in which special characters are not written as %40 and the like.

    Raises:
        Unreachable.
    """
    try:
        read = conninfo_to_dict(address)
        if "@" in str(read.get("host", "")) or not str(read.get("port", "0")).replace(",", "").isdigit():
            raise psycopg.ProgrammingError("a password that is cut off")
    except psycopg.ProgrammingError:
        text = "has an address that cannot be read; write special characters of a password as %40 and the like."
        raise Unreachable("PostgreSQL", text) from None


class Postgres:
    """Connections to a PostgreSQL, which is connected to when it is first used.  Any thread may use it.

    Every method may raise StoreUnavailable (it cannot be reached, or refuses the service), StorageFull or
    StorageFailure (it refuses).

    Args:
        address: as libpq takes it, such as ``postgresql://placerec@db/placerec``.
        make_tables: is called once, in a transaction of its own, before anything else.
        most_connections: at the same time.
        settings: of its connections besides the common ones.
        configure: is called with each new connection.
    """

    def __init__(
        self,
        address: str,
        make_tables: Callable[[Connection[Any]], None],
        most_connections: int,
        settings: Mapping[str, Any],
        configure: Callable[[Connection[Any]], None] | None = None,
    ) -> None:
        self.address, self._make_tables, self._most = address, make_tables, most_connections
        self._settings, self._configure = {**SETTINGS, **settings}, configure
        self._outage = Outage("PostgreSQL", probe=self._probe)
        self._lost = -math.inf  # when a connection was lost, by the monotonic clock
        self._opening = threading.Lock()
        self._pool: ConnectionPool[TimedConnection] | None = None

    def _opened(self) -> ConnectionPool[TimedConnection]:
        """The pool of connections to a database whose tables are there."""
        if (pool := self._pool) is not None:
            return pool
        with self._opening:
            if self._pool is None:
                with self.alone("make its tables", LONG_SECONDS) as connection, connection.transaction():
                    self._make_tables(connection)
                self._pool = ConnectionPool(
                    self.address, connection_class=TimedConnection, min_size=1, max_size=self._most,
                    timeout=PATIENCE_SECONDS, kwargs=self._settings,
                    configure=self._configure, check=self._check, open=True,
                    reconnect_timeout=_RECONNECTING_SECONDS,
                )  # fmt: skip
            return self._pool

    @contextmanager
    def alone(self, action: str, seconds: float = ANSWER_SECONDS) -> Iterator[TimedConnection]:
        """A connection outside the pool, which says why there is none.

        Args:
            seconds: how long each statement may take.
        """
        check_address(self.address)
        with postgres_errors(action), TimedConnection.connect(self.address, **self._settings) as connection:
            connection.seconds = seconds
            yield connection

    def _check(self, connection: TimedConnection) -> None:
        """Raise unless a connection answers; it is not asked if it did a moment ago, and no other was lost since."""
        if connection.answered < max(self._lost, time.monotonic() - CHECKED_SECONDS):
            _check(connection)

    def _probe(self) -> None:
        """Raise Unreachable unless PostgreSQL answers soon."""
        settings = {**self._settings, "connect_timeout": PROBE_SECONDS}
        with postgres_errors("answer"), TimedConnection.connect(self.address, **settings) as connection:
            _check(connection)

    @contextmanager
    def connection(self, action: str, seconds: float = ANSWER_SECONDS) -> Iterator[TimedConnection]:
        """A connection of the pool; uncommitted changes of the block are undone if it raises, else committed.

        Args:
            action: the work of the block, for the message of an error.
            seconds: how long each statement may take.
        """
        with self._outage.noticed():
            pool = self._opened()
            try:
                with postgres_errors(action), pool.connection() as connection:
                    connection.seconds = seconds
                    try:
                        yield connection
                    finally:
                        connection.seconds = ANSWER_SECONDS
            except PoolTimeout as error:
                with self.alone("answer"):  # raises if it cannot be reached
                    pass
                raise StoreUnavailable("All connections to PostgreSQL are in use.") from error
            except Unreachable:
                self._lost = time.monotonic()
                raise

    def close(self) -> None:
        """Close all connections."""
        with self._opening:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.close()


def _check(connection: TimedConnection) -> None:
    """Raise unless a connection answers soon."""
    connection.seconds = PROBE_SECONDS
    ConnectionPool.check_connection(connection)
    connection.seconds = ANSWER_SECONDS


class PostgresConnection:
    """A connection of the pool (:class:`core.ledger.database.LedgerConnection`)."""

    dialect: Literal["postgresql"] = "postgresql"

    def __init__(self, connection: Connection[Any]) -> None:
        self.driver = connection

    def execute(self, statement: Statement, **values: Any) -> list[tuple[Any, ...]]:
        """Execute a statement; the rows that it gives."""
        compiled = statement.compiled("postgresql")
        cursor = self.driver.execute(compiled.text, compiled.values(values))
        return cursor.fetchall() if compiled.returns else []

    def pages(self, statement: Statement, size: int, **values: Any) -> Iterator[list[tuple[Any, ...]]]:
        """Execute a statement within a transaction; the rows that it gives, up to ``size`` at a time."""
        compiled = statement.compiled("postgresql")
        with self.driver.cursor(name="placerec_pages") as cursor:
            cursor.itersize = size
            cursor.execute(compiled.text, compiled.values(values))
            while page := cursor.fetchmany(size):
                yield page

    def execute_many(self, statement: Statement, values: Sequence[Mapping[str, Any]]) -> None:
        """Execute a statement once for each of some sets of values."""
        compiled = statement.compiled("postgresql")
        with self.driver.cursor() as cursor:
            cursor.executemany(compiled.text, [compiled.values(one) for one in values])

    def change(self, statement: Statement, **values: Any) -> int:
        """Execute a statement; the number of rows that it inserted, updated or deleted."""
        compiled = statement.compiled("postgresql")
        return self.driver.execute(compiled.text, compiled.values(values)).rowcount


def prepare(connection: Connection[Any], tables: Sequence[Tables]) -> None:
    """Make the tables of some parts that are missing, and bring those of earlier versions up to date.

    Raises:
        StoreOfAnotherVersion: tables are of a version that is not read, or another program's; all are as they were.
    """
    connection.execute("SELECT pg_advisory_xact_lock(%s)", (Lock.TABLES,))
    connection.execute("CREATE TABLE IF NOT EXISTS placerec_tables (part text PRIMARY KEY, version integer NOT NULL)")
    versions = dict(connection.execute("SELECT part, version FROM placerec_tables").fetchall())
    for part in tables:
        found = versions.get(part.name)
        if found == part.version:
            continue
        statements = part.create("postgresql") if found is None else part.migrate("postgresql", found)
        if statements is None:
            raise StoreOfAnotherVersion(
                f"The tables of {part.name} in PostgreSQL are those of version {found}, which this placerec does not"
                f" read; it reads version {part.version}. They are left as they are: go on with the version that made"
                " them, or begin anew in another database."
            )
        try:
            for statement in statements:
                connection.execute(statement)
        except (psycopg.errors.DuplicateTable, psycopg.errors.DuplicateObject) as error:
            raise StoreOfAnotherVersion(
                f"PostgreSQL's database has something that another program has made where placerec has its {part.name}:"
                f" {_in_one_line(error)}. It is left as it is: name an empty database."
            ) from error
        query = (
            "INSERT INTO placerec_tables VALUES (%s, %s) ON CONFLICT (part) DO UPDATE SET version = excluded.version"
        )
        connection.execute(query, (part.name, part.version))


class PostgresLedger(Postgres):
    """A ledger in a PostgreSQL (:class:`core.ledger.database.Ledger`); tables that are missing are made.

    Args:
        tables: of the parts that are kept in it.
        statement_seconds: how long a statement may take; 0: as long as it takes.
    """

    def __init__(
        self, address: str, tables: Sequence[Tables], most_connections: int = 8, statement_seconds: int = 10
    ) -> None:
        def configure(connection: Connection[Any]) -> None:
            connection.execute("SET synchronous_commit TO on")  # a commit is durable whatever the server's default is
            connection.execute(f"SET statement_timeout TO '{statement_seconds}s'")

        super().__init__(
            address, lambda connection: prepare(connection, tables), most_connections, {"autocommit": True}, configure
        )

    def execute(self, action: str, statement: Statement, **values: Any) -> list[tuple[Any, ...]]:
        """Execute one statement, which is durable when this returns; the rows that it gives."""
        with self.connection(action) as connection:
            return PostgresConnection(connection).execute(statement, **values)

    def change(self, action: str, statement: Statement, **values: Any) -> int:
        """The same; the number of rows that it inserted, updated or deleted."""
        with self.connection(action) as connection:
            return PostgresConnection(connection).change(statement, **values)

    @contextmanager
    def transaction(
        self, action: str, lock: Lock | None = None, seconds: float = 2 * ANSWER_SECONDS
    ) -> Iterator[PostgresConnection]:
        """A transaction that is committed at the end of the block, and undone if it raises.

        Args:
            lock: only one transaction with it runs at a time, over all services.
            seconds: how long each statement may take, waiting for others' locks included.
        """
        with self.connection(action, seconds) as connection, connection.transaction():
            if lock is not None:
                connection.execute("SELECT pg_advisory_xact_lock(%s)", (lock,))
            yield PostgresConnection(connection)

    @contextmanager
    def glancing(self, action: str = "read") -> Iterator[PostgresConnection]:
        """A connection for single statements, each of which sees its own moment."""
        with self.connection(action) as connection:
            yield PostgresConnection(connection)

    @contextmanager
    def reading(self, action: str = "read") -> Iterator[PostgresConnection]:
        """A transaction that sees the moment of its first statement, and writes nothing."""
        with self.connection(action) as connection:
            connection.execute("BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY")
            try:
                yield PostgresConnection(connection)
            finally:
                if not connection.closed:
                    connection.execute("ROLLBACK")

    @contextmanager
    def locked(self, action: str, kind: int, number: int, wait: bool = True) -> Iterator[PostgresConnection | None]:
        """Hold a lock of the database on a connection of its own; None if another has it and ``wait`` is not set.

        The lock is gone when the connection is lost, and then the connection takes no further statement.
        """
        key = (kind, number % 2**31)
        with self.connection(action, LONG_SECONDS) as connection:
            if wait:
                connection.execute("SELECT pg_advisory_lock(%s::int, %s::int)", key)
            elif connection.execute("SELECT pg_try_advisory_lock(%s::int, %s::int)", key).fetchone() != (True,):
                yield None
                return
            try:
                yield PostgresConnection(connection)
            finally:
                with suppress(psycopg.Error):  # a lost connection has no lock
                    connection.execute("SELECT pg_advisory_unlock(%s::int, %s::int)", key)

    def check(self) -> None:
        """Ask it whether it takes writes.

        Raises:
            StoreUnavailable, StoreOfAnotherVersion, StorageFailure: it does not.
        """
        with self.connection("answer") as connection:
            found = connection.execute("SELECT pg_is_in_recovery()").fetchone()
        if found != (False,):
            raise Unreachable("PostgreSQL", "takes no writes: it is a standby.")

    def notify(self, action: str, channel: str, text: str) -> None:
        """Send a text, of at most 7999 bytes, to those who listen to a channel now."""
        with self.connection(action) as connection:
            connection.execute("SELECT pg_notify(%s, %s)", (channel, text))

    @contextmanager
    def listening(self, channel: str) -> Iterator[Callable[[float], Iterator[str]]]:
        """Listen to a channel in the block, by a connection outside the pool.

        Yields:
            A function that waits for some seconds, and gives the texts that arrive meanwhile.
        """
        with self.alone("listen") as connection:
            connection.execute(f"LISTEN {channel}")
            yield lambda seconds: (notice.payload for notice in connection.notifies(timeout=seconds))
