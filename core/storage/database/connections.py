"""SQLite under many threads: one connection that writes, and as many as needed that read.

In WAL mode readers see the last commit and never wait for the writer.  With ``synchronous=FULL``
a COMMIT returns when the log is synced; SQLite also syncs the folder when it makes the log.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from core.disk import sqlite_file
from core.disk.files import sync_file
from core.disk.sqlite_file import DURABLE
from core.storage.database import row_checksums as seals
from core.storage.database.schema import check_schema, migrate

FILE = "map.sqlite"

_IDLE_READERS = 8
_LOG_BYTES = 64 << 20  # to which a log that a large batch made longer is cut again


class DatabaseClosed(Exception):
    """The database was closed, for good, before this use of it."""


_SETTINGS = {**DURABLE, "foreign_keys": "ON", "temp_store": "MEMORY", "journal_size_limit": _LOG_BYTES}


def connect(path: Path, create: bool = False) -> sqlite3.Connection:
    """A connection with the settings of a map and no implicit transactions; any thread may use it, one at a time.

    Raises:
        sqlite3.Error: the file is missing (unless ``create``) or cannot be read.
    """
    connection = sqlite_file.connect(path, "rwc" if create else "rw", _SETTINGS)
    seals.teach(connection)
    return connection


def connect_without_log(path: Path) -> sqlite3.Connection:
    """A connection that reads the file as if it had no log, and changes neither of them.

    Raises:
        sqlite3.Error: it cannot be read.
    """
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True, isolation_level=None, check_same_thread=False
    )
    connection.execute("PRAGMA trusted_schema = OFF")
    seals.teach(connection)
    return connection


class Database:
    """``map.sqlite`` in use.  The caller sees to it that one thread writes at a time."""

    def __init__(self, path: Path) -> None:
        """Open and, where it is older, migrate.

        Raises:
            DataDirectoryTooNew: a later version wrote it.
            Damage: it is not one of ours.
            sqlite3.Error: it cannot be read.
        """
        self._path = path
        self._writer = connect(path)
        try:
            migrate(self._writer)
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
        """Another one after every transaction: whoever finds the same again knows that nothing was written."""

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """A connection for this thread alone.

        Raises:
            DatabaseClosed: too late.
        """
        with self._condition:
            if self._closed:
                raise DatabaseClosed
            self._reading += 1
            connection = self._idle.pop() if self._idle else None
        try:
            if connection is None:
                connection = connect(self._path)
            yield connection
        finally:
            with self._condition:
                self._reading -= 1
                # One left in the middle of a transaction would see that moment for ever.
                if connection is not None and not connection.in_transaction and len(self._idle) < _IDLE_READERS:
                    self._idle.append(connection)
                    connection = None
                if connection is not None:
                    connection.close()
                self._condition.notify_all()

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """All of the block's statements or none; synced when it is left without an error.

        Raises:
            DatabaseClosed: too late.
        """
        if self._closed:
            raise DatabaseClosed
        try:
            with sqlite_file.transaction(self._writer):
                yield self._writer
        finally:
            self.state = object()

    def settle(self) -> None:
        """Empty the log after a COMMIT that failed while it was being synced.

        Such a commit is taken back in memory, but its frames may have reached the disk, where a
        crash would bring them to life again.

        Raises:
            OSError, sqlite3.Error: the log could not be emptied.
        """
        (busy, _, _) = self._writer.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        if busy:
            raise sqlite3.OperationalError("readers keep the log from being emptied")
        sync_file(self._path.with_name(f"{self._path.name}-wal"))  # or a power cut could bring back what was in it

    def close(self) -> None:
        """Let the reads under way end, refuse further ones, and close.

        No connection may outlive its file's name: SQLite removes the log by its path when the last
        one closes, and that path may belong to a new map by then.
        """
        with self._condition:
            self._closed = True
            self._condition.wait_for(lambda: self._reading == 0)
            for connection in self._idle:
                connection.close()
            self._idle.clear()
        self._writer.close()
