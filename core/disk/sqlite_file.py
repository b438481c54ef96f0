"""SQLite files: how they are opened, created and checked.

A file names who wrote it by its ``application_id`` (0 where a kind of file has none) and the version of its tables by
its ``user_version``.  A new file gets its tables in one transaction, so that a crash leaves it either empty or
complete.  A file of another version is refused and left as it is.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from core.disk.files import Damage, is_full
from core.disk.permissions import make_private
from core.disk.reserve import lent_to
from core.errors import DataDirectoryTooNew, DataDirectoryTooOld

log = logging.getLogger(__name__)

Mode = Literal["ro", "rw", "rwc"]
"""Read only; read and write; the same and create the file if it is missing."""

DURABLE: Mapping[str, str | int] = {"journal_mode": "WAL", "synchronous": "FULL", "trusted_schema": "OFF"}
"""Settings with which a COMMIT returns when SQLite's log is synced, and readers never wait for the writer."""


class NotOurs(Damage):
    """The file is a database, but of another program or of another kind."""


class UnreadVersion(Exception):
    """The tables of the file have a version that is not read: a later one, or one from before the first release."""

    def __init__(self, version: int, known: int) -> None:
        writer = "by a later version of placerec" if version > known else "before the first release of placerec"
        super().__init__(f"was written {writer} (schema {version}, this one knows {known})")
        self.version, self.known = version, known

    def refusal(self, file: str) -> DataDirectoryTooNew | DataDirectoryTooOld:
        """The error that users see, about the ``file`` of this name."""
        if self.version > self.known:
            return DataDirectoryTooNew(f"{file} {self}.")
        return DataDirectoryTooOld(
            f"{file} {self} and is left as it is: enrol again in a new data directory, or go on with the version that "
            "wrote it."
        )


def connect(
    path: Path, mode: Mode = "rw", settings: Mapping[str, str | int] = DURABLE, timeout: float = 30
) -> sqlite3.Connection:
    """A connection without implicit transactions; any thread may use it, one at a time.

    On a full disk a file that is there is opened with room that is held back (:mod:`core.disk.reserve`).

    Args:
        settings: pragmas to set, in this order.
        timeout: seconds to wait for another process's lock.

    Raises:
        sqlite3.Error: the file is missing (unless ``mode`` is ``rwc``) or cannot be read.
        OSError: a new file cannot be made.
    """
    if mode == "rwc":
        make_private(path)  # SQLite gives its logs the same permissions
    try:
        return _connected(path, mode, settings, timeout)
    except sqlite3.OperationalError as error:
        if not is_full(error):
            raise
        with lent_to(path) as lent:
            if not lent:
                raise
            return _connected(path, mode, settings, timeout)


def _connected(path: Path, mode: Mode, settings: Mapping[str, str | int], timeout: float) -> sqlite3.Connection:
    address = f"{path.absolute().as_uri()}?mode={mode}"
    connection = sqlite3.connect(address, uri=True, timeout=timeout, isolation_level=None, check_same_thread=False)
    try:
        for name, value in settings.items():
            connection.execute(f"PRAGMA {name} = {value}")
        connection.execute("PRAGMA schema_version").fetchall()  # reads the file, which makes that of the log's index
    except BaseException:
        connection.close()
        raise
    return connection


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """Execute all statements of the block or none; they are committed when it ends without an error."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):  # the first error is the one to report
            if connection.in_transaction:
                connection.execute("ROLLBACK")
        raise


_REWRITING = threading.Lock()  # the folder for temporary files is one for all connections of the process


def rewrite(connection: sqlite3.Connection, folder: Path) -> None:
    """Rewrite a file so that nothing is left in it of what was deleted; its log has yet to be emptied.

    Deleted content is overwritten where it was (``secure_delete``), but a page that was split may still have a copy.
    The connection's ``temp_store`` is FILE afterwards.

    Args:
        folder: for the copy that SQLite makes meanwhile, a file that has no name.

    Raises:
        sqlite3.Error: the disk refuses, or has too little room; the file is as it was.
    """
    quoted = str(folder.absolute()).replace("'", "''")
    with _REWRITING:
        connection.execute("PRAGMA temp_store = FILE")
        connection.execute(f"PRAGMA temp_store_directory = '{quoted}'")
        try:
            connection.execute("VACUUM")
        finally:
            connection.execute("PRAGMA temp_store_directory = ''")


@dataclass(frozen=True)
class Schema:
    """The tables of one kind of file.

    application_id: names the kind of file; 0 for kinds that have none.
    version: of the tables.
    create: statements that make them in an empty file.
    migrate: gives the statements that bring tables of an earlier version up to date; None if they are not read.
    """

    application_id: int
    version: int
    create: Sequence[str]
    migrate: Callable[[int], Sequence[str] | None] = lambda _version: None

    def prepare(self, connection: sqlite3.Connection, create: bool = False) -> None:
        """See that a file has these tables.

        Args:
            create: make the tables, all or none, if the file is empty.

        Raises:
            NotOurs: the file is of another kind, or empty without ``create``.
            UnreadVersion: its tables are of a later version, or of one that is too old.
            sqlite3.Error: a statement failed; the file is as it was.
        """
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        (owner,) = connection.execute("PRAGMA application_id").fetchone()
        query = "SELECT count(*) FROM sqlite_schema"
        if create and (version, owner) == (0, 0) and connection.execute(query).fetchone() == (0,):
            self._bring_up_to_date(connection, self.create)
        elif version < 1 or owner != self.application_id:
            raise NotOurs("it is a database, but not one of placerec's")
        elif version != self.version:
            statements = self.migrate(version)
            if statements is None:
                raise UnreadVersion(version, self.version)
            self._bring_up_to_date(connection, statements)

    def _bring_up_to_date(self, connection: sqlite3.Connection, statements: Sequence[str]) -> None:
        with transaction(connection):
            for statement in statements:
                connection.execute(statement)
            connection.execute(f"PRAGMA application_id = {self.application_id}")
            connection.execute(f"PRAGMA user_version = {self.version}")


@dataclass(frozen=True)
class SqliteFile:
    """A small database in the data directory.

    settings, timeout: as for :func:`connect`.
    checks: queries that must succeed when the file is opened.
    check_whole: let SQLite check all of the file when it is opened (``quick_check``).
    """

    path: Path
    schema: Schema
    settings: Mapping[str, str | int] = field(default_factory=lambda: DURABLE)
    checks: Sequence[str] = ()
    check_whole: bool = True
    timeout: float = 30

    def open(self, create: bool = True) -> sqlite3.Connection:
        """A connection to the file, which is checked.

        Args:
            create: make the file if it is missing or empty, and see that it can be written to.

        Raises:
            Damage: the file is damaged, or NotOurs.
            UnreadVersion: its tables are of a later version, or of one that is too old.
            OSError, sqlite3.OperationalError: the disk refuses.
        """
        try:
            connection = connect(self.path, "rwc" if create else "rw", self.settings, self.timeout)
            try:
                self.schema.prepare(connection, create)
                if self.check_whole:
                    for (line,) in connection.execute("PRAGMA quick_check").fetchall():
                        if line != "ok":
                            raise Damage(line)
                for query in self.checks:
                    connection.execute(query).fetchall()
                if create:
                    expect_writable(connection)
            except BaseException:
                connection.close()
                raise
        except UnicodeDecodeError as error:
            raise Damage("its text is damaged") from error
        except sqlite3.DatabaseError as error:
            message = str(error)
            if isinstance(error, sqlite3.OperationalError) and "no such" not in message and "decode" not in message:
                raise  # the disk refuses, which says nothing about the file
            raise Damage(message) from error
        return connection

    def put_aside(self, reason: Exception) -> Path:
        """Rename a damaged file, so that a new one can be made in its place; returns its new path.

        Raises:
            OSError: the disk refuses.
        """
        aside = self.path.with_name(f"{self.path.name}.damaged-{datetime.now(UTC):%Y%m%dT%H%M%S}")
        log.error("%s cannot be read and is put aside as %s: %s", self.path, aside.name, reason)
        self.path.rename(aside)
        for suffix in ("-wal", "-shm"):
            self.path.with_name(self.path.name + suffix).unlink(missing_ok=True)
        return aside

    def open_or_replace(self) -> sqlite3.Connection:
        """A connection to the file; a damaged one, or one that is not read, is put aside first and made anew.

        Raises:
            OSError, sqlite3.OperationalError: the disk refuses.
        """
        try:
            return self.open()
        except (Damage, UnreadVersion) as error:
            self.put_aside(error)
            return self.open()


def expect_writable(connection: sqlite3.Connection) -> None:
    """Raise sqlite3.OperationalError if the file cannot be written to.

    SQLite silently opens a file read-only where writing is refused, and would keep it so when the refusal is over.
    """
    query = "SELECT name FROM sqlite_schema WHERE type = 'table' AND name NOT LIKE 'sqlite_%' LIMIT 1"
    for (table,) in connection.execute(query).fetchall():
        connection.execute(f'DELETE FROM "{table}" WHERE false')
