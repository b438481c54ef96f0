"""The connections to a map's database: one that writes, and as many as needed that read.

In WAL mode readers see the last commit and never wait for the writer.  With ``synchronous=FULL`` a COMMIT returns when
the log is synced; SQLite also syncs the folder when it creates the log.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from core.disk import sqlite_file
from core.disk.files import sync_file
from core.disk.sqlite_file import DURABLE, rewrite
from core.ledger.maps.connection import MapConnection
from core.storage.database.schema import check_schema, connection_of, driver_of, prepare

FILE = "map.sqlite"

_IDLE_READERS = 8
_LOG_BYTES = 64 << 20  # a log that a large batch made longer is cut to this size


@contextmanager
def at_one_moment(connection: MapConnection) -> Iterator[None]:
    """All statements of the block see the moment of the first one that reads."""
    driver = driver_of(connection)
    driver.execute("BEGIN")
    try:
        yield
    finally:
        if driver.in_transaction:  # SQLite ends some transactions itself, when the disk fails
            driver.execute("ROLLBACK")


def read_now(connection: MapConnection) -> None:
    """Have a transaction see this moment."""
    driver_of(connection).execute("SELECT number FROM maps").fetchall()


class DatabaseClosed(Exception):
    """The database was closed before this use of it."""


_SETTINGS = {**DURABLE, "secure_delete": "ON", "temp_store": "MEMORY", "journal_size_limit": _LOG_BYTES}


def connect(path: Path, create: bool = False) -> sqlite3.Connection:
    """A connection with the settings of a map and no implicit transactions; any thread may use it, one at a time.

    Raises:
        sqlite3.Error: the file is missing (unless ``create``) or cannot be read.
        OSError: a new file cannot be made.
    """
    return sqlite_file.connect(path, "rwc" if create else "rw", _SETTINGS)


def connect_without_log(path: Path) -> sqlite3.Connection:
    """A connection that reads the file as if it had no log, and changes neither of them.

    Raises:
        sqlite3.Error: it cannot be read.
    """
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True, isolation_level=None, check_same_thread=False
    )
    connection.execute("PRAGMA trusted_schema = OFF")
    return connection


class Database:
    """``map.sqlite`` of an open map.  Any thread may read; the caller ensures that only one writes at a time."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            DataDirectoryTooNew, DataDirectoryTooOld: it is of a version that is not read.
            Damage: it is not the database of a map.
            sqlite3.Error: it cannot be read.
        """
        self._path = path
        self._writer = connect(path)
        try:
            prepare(self._writer, str(path))
            check_schema(self._writer)
            sqlite_file.expect_writable(self._writer)
        except BaseException:
            self._writer.close()
            raise
        self._condition = threading.Condition()
        self._idle: list[sqlite3.Connection] = []
        self._reading = 0
        self._closed = False
        self.state = object()
        """A new object after every transaction; as long as it is the same object, nothing was written."""

    @contextmanager
    def reading(self) -> Iterator[MapConnection]:
        """A connection for the calling thread alone.

        Raises:
            DatabaseClosed: the database was closed.
        """
        with self._condition:
            if self._closed:
                raise DatabaseClosed
            self._reading += 1
            connection = self._idle.pop() if self._idle else None
        try:
            if connection is None:
                connection = connect(self._path)
            yield connection_of(connection)
        finally:
            with self._condition:
                self._reading -= 1
                # A connection within a transaction would see the moment of its beginning for ever.
                if connection is not None and not connection.in_transaction and len(self._idle) < _IDLE_READERS:
                    self._idle.append(connection)
                    connection = None
                if connection is not None:
                    connection.close()
                self._condition.notify_all()

    @contextmanager
    def transaction(self) -> Iterator[MapConnection]:
        """Execute all statements of the block or none; they are synced when it ends without an error.

        Raises:
            DatabaseClosed: the database was closed.
        """
        if self._closed:
            raise DatabaseClosed
        try:
            with sqlite_file.transaction(self._writer):
                yield connection_of(self._writer)
        finally:
            self.state = object()

    def empty_log(self) -> None:
        """Empty the log after a COMMIT that failed while the log was being synced.

        Such a commit is undone in memory, but its frames may have reached the disk, from where SQLite would replay them
        after a crash.

        Raises:
            OSError, sqlite3.Error: the log could not be emptied.
        """
        (busy, _, _) = self._writer.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        if busy:
            raise sqlite3.OperationalError("readers keep the log from being emptied")
        sync_file(self._path.with_name(f"{self._path.name}-wal"))  # or a power cut could restore its former content

    def erase(self) -> int:
        """Rewrite the file without what was deleted from it, and empty the log; the bytes by which it got smaller.

        The caller ensures that nobody writes meanwhile.  This takes as much room on the disk again as the file has.

        Raises:
            OSError, sqlite3.Error: the disk refuses, or readers keep the log from being emptied.
        """
        before = self._path.stat().st_size
        rewrite(self._writer, self._path.parent)
        self._writer.execute("PRAGMA temp_store = MEMORY")
        self.empty_log()
        return max(0, before - self._path.stat().st_size)

    def close(self) -> None:
        """Wait for reads under way, refuse further ones, and close all connections.

        No connection may be open when the file gets another name: SQLite deletes the log by its path when the last
        connection closes, and that path may belong to a new map by then.
        """
        with self._condition:
            self._closed = True
            self._condition.wait_for(lambda: self._reading == 0)
            for connection in self._idle:
                connection.close()
            self._idle.clear()
        self._writer.close()
