"""A ledger in an SQLite file of the data directory, which this process holds."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Literal

from core.disk.files import disk_errors
from core.disk.sqlite_file import DURABLE, Schema, SqliteFile, UnreadVersion, transaction
from core.ledger.database import Lock
from core.ledger.statements import Statement
from core.ledger.tables import Tables


def file_of(
    path: Path,
    tables: Tables,
    settings: Mapping[str, str | int] = DURABLE,
    checks: Sequence[str] = (),
    check_whole: bool = True,
    timeout: float = 30,
) -> SqliteFile:
    """The SQLite file that has some tables (:class:`core.disk.sqlite_file.SqliteFile`)."""
    create = tables.create("sqlite")
    schema = Schema(tables.application_id, tables.version, create, lambda version: tables.migrate("sqlite", version))
    return SqliteFile(path, schema, settings, checks, check_whole, timeout)


class SqliteConnection:
    """A connection to a file (:class:`core.ledger.database.LedgerConnection`)."""

    dialect: Literal["sqlite"] = "sqlite"

    def __init__(self, connection: sqlite3.Connection) -> None:
        self.driver = connection

    def execute(self, statement: Statement, **values: Any) -> list[tuple[Any, ...]]:
        """Execute a statement; the rows that it gives."""
        compiled = statement.compiled("sqlite")
        return self.driver.execute(compiled.text, compiled.values(values)).fetchall()

    def pages(self, statement: Statement, size: int, **values: Any) -> Iterator[list[tuple[Any, ...]]]:
        """Execute a statement; the rows that it gives, up to ``size`` at a time."""
        compiled = statement.compiled("sqlite")
        with closing(self.driver.execute(compiled.text, compiled.values(values))) as cursor:
            while page := cursor.fetchmany(size):
                yield page

    def execute_many(self, statement: Statement, values: Sequence[Mapping[str, Any]]) -> None:
        """Execute a statement once for each of some sets of values."""
        compiled = statement.compiled("sqlite")
        self.driver.executemany(compiled.text, [compiled.values(one) for one in values])

    def change(self, statement: Statement, **values: Any) -> int:
        """Execute a statement; the number of rows that it inserted, updated or deleted."""
        compiled = statement.compiled("sqlite")
        with closing(self.driver.execute(compiled.text, compiled.values(values))) as cursor:
            return cursor.rowcount


class SqliteLedger:
    """A ledger in one file (:class:`core.ledger.database.Ledger`).  One thread uses its connection at a time.

    Args:
        connection: to the file, without implicit transactions; it is closed with the ledger.
        name: of the file, for the messages of errors.
    """

    def __init__(self, connection: sqlite3.Connection, name: str) -> None:
        self._connection, self._name = SqliteConnection(connection), name
        self._lock = threading.RLock()

    @classmethod
    def open(cls, file: SqliteFile, replace_damaged: bool = False) -> SqliteLedger:
        """The ledger in a file, which is made if it is missing.

        Args:
            replace_damaged: put a damaged file aside, and make a new one.

        Raises:
            Damage: the file is damaged, or of another program.
            DataDirectoryTooNew, DataDirectoryTooOld: its tables are of a version that is not read.
            StorageFull, StorageFailure: the disk refuses.
        """
        with disk_errors(f"open {file.path.name}", file.path.name):
            try:
                return cls(file.open_or_replace() if replace_damaged else file.open(), file.path.name)
            except UnreadVersion as error:
                raise error.refusal(str(file.path)) from error

    def execute(self, action: str, statement: Statement, **values: Any) -> list[tuple[Any, ...]]:
        """Execute one statement, which is durable when this returns; the rows that it gives."""
        with self._lock, disk_errors(action, self._name):
            return self._connection.execute(statement, **values)

    def change(self, action: str, statement: Statement, **values: Any) -> int:
        """The same; the number of rows that it inserted, updated or deleted."""
        with self._lock, disk_errors(action, self._name):
            return self._connection.change(statement, **values)

    @contextmanager
    def transaction(self, action: str, lock: Lock | None = None) -> Iterator[SqliteConnection]:
        """A transaction that is synced at the end of the block, and undone if it raises; ``lock`` is not needed."""
        with self._lock, disk_errors(action, self._name), transaction(self._connection.driver):
            yield self._connection

    def close(self) -> None:
        """Write the log back and close the file."""
        with self._lock:
            self._connection.driver.close()
