"""The file of keys in a data directory: small, apart from the maps and not under their lock.

Each use opens it anew, since other processes write to it, such as a command while the service runs.  It fails closed.
If it exists, keys are needed, whatever it contains; and nobody is let in if it is empty, damaged, of a later version,
or writable by others.
"""

from __future__ import annotations

import os
import secrets
import sqlite3
import stat
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from core.disk.files import Damage, make_folder, sync_folder
from core.disk.sqlite_file import NotOurs, SqliteFile, UnreadVersion, transaction
from core.ledger import LedgerConnection, Statement
from core.ledger.sqlite import SqliteConnection, file_of
from service.access.key_table import TABLES
from service.errors.faults import KeysUnreadable

FILE = "keys.sqlite"
BUSY_SECONDS = 5.0

DURABLE = {"synchronous": "EXTRA"}
"""A rollback journal, since the file is all there is of the keys.  EXTRA syncs the folder too, or a power cut could
bring the journal back, and with it a key that was revoked."""


@dataclass(frozen=True)
class _Watched:
    """The file as it was when a connection to it was opened, with its attributes in the file system."""

    connection: sqlite3.Connection
    traits: tuple[int, ...]


class KeyFile:
    """The table of keys in a file of a data directory (:class:`service.access.key_table.KeyPlace`)."""

    remote: ClassVar[bool] = False

    def __init__(self, directory: Path) -> None:
        self.path = directory / FILE
        self._watched: _Watched | None = None
        self._opened = 0

    def exists(self) -> bool:
        try:
            self.path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError as error:
            raise self._hidden(error) from error
        return True

    def prepare(self) -> None:
        """Make the file whole or not at all: one without its tables would count as damaged."""
        temporary = self.path.with_name(f"{FILE}.{secrets.token_hex(4)}.tmp")
        with self._refusals():
            make_folder(self.path.parent)
            try:
                _file(temporary).open().close()
                with suppress(FileExistsError):  # another process was quicker
                    os.link(temporary, self.path)
                sync_folder(self.path.parent)
            finally:
                with suppress(FileNotFoundError):
                    temporary.unlink()

    def execute(self, statement: Statement) -> list[tuple[Any, ...]]:
        if not self.exists():
            return []
        with closing(self._open()) as connection, self._refusals():
            return SqliteConnection(connection).execute(statement)

    @contextmanager
    def changing(self, announced: bool = True) -> Iterator[LedgerConnection]:
        with closing(self._open()) as connection, self._refusals(), transaction(connection):
            yield SqliteConnection(connection)

    def version(self, expected: bool) -> object:
        """The attributes of the file, and SQLite's count of the changes that others make; neither reads a key."""
        try:
            status = os.stat(self.path)
        except FileNotFoundError:
            if expected:
                raise KeysUnreadable(f"{self.path} is gone.") from None
            return None
        except OSError as error:
            raise self._hidden(error) from error
        traits = _traits(status)
        with self._refusals():
            if self._watched is None or self._watched.traits != traits:
                self.close()
                self._watched, self._opened = _Watched(self._open(), traits), self._opened + 1
            return traits, self._opened, self._watched.connection.execute("PRAGMA data_version").fetchone()

    def close(self) -> None:
        watched, self._watched = self._watched, None
        if watched is not None:
            watched.connection.close()

    def _open(self) -> sqlite3.Connection:
        """A connection to the file, after checking that it is intact and a file of keys."""
        with self._refusals():
            status = self.path.stat()
            if not stat.S_ISREG(status.st_mode) or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                raise KeysUnreadable(f"Others may write to {self.path}: chmod 600 it, then look whose keys it holds.")
            try:
                return _file(self.path).open(create=False)
            except UnreadVersion as error:
                raise KeysUnreadable(str(error.refusal(str(self.path)))) from error
            except NotOurs as error:
                raise KeysUnreadable(
                    f"{self.path} is not a file of keys, or it is damaged; nobody is let in. Restore it."
                ) from error
            except Damage as error:
                raise KeysUnreadable(f"{self.path} is damaged: {error}.") from error

    def _hidden(self, error: OSError) -> KeysUnreadable:
        return KeysUnreadable(f"{self.path} cannot be looked at: {error.strerror}.")

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        try:
            yield
        except (OSError, sqlite3.Error, Damage) as error:
            raise KeysUnreadable(f"{self.path} cannot be used: {error}.") from error


def _file(path: Path) -> SqliteFile:
    return file_of(path, TABLES, DURABLE, timeout=BUSY_SECONDS)


def _traits(status: os.stat_result) -> tuple[int, ...]:
    """Attributes that change when a file is replaced, or written to without SQLite."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_mode
