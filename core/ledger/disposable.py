"""A ledger in an SQLite file whose records may be lost, as counts may: what is damaged begins anew."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from core.disk.files import Damage, disk_errors
from core.disk.sqlite_file import SqliteFile
from core.errors import StorageFailure
from core.ledger.database import Lock
from core.ledger.sqlite import SqliteConnection, SqliteLedger
from core.ledger.statements import Statement

P = ParamSpec("P")
T = TypeVar("T")


class Replaced(StorageFailure):
    """The file turned out to be damaged, and was put aside: the next use makes a new one."""


def once_more_if_replaced(work: Callable[P, T]) -> Callable[P, T]:
    """Make a function that does some work again, with the new file, when the old one turns out to be damaged."""

    @wraps(work)
    def done(*given: P.args, **named: P.kwargs) -> T:
        try:
            return work(*given, **named)
        except Replaced:
            return work(*given, **named)

    return done


class DisposableLedger:
    """A ledger in a file that is made anew if it is damaged (:class:`core.ledger.database.Ledger`).

    The file is opened when it is first used, so that a disk that refuses at the start keeps nothing from starting.
    Every method may raise StorageFull or StorageFailure, and Replaced.
    """

    def __init__(self, file: SqliteFile) -> None:
        self._file = file
        self._lock = threading.RLock()
        self._opened: SqliteLedger | None = None

    def execute(self, action: str, statement: Statement, **values: Any) -> list[tuple[Any, ...]]:
        """Execute one statement; the rows that it gives."""
        with self._use() as ledger:
            return ledger.execute(action, statement, **values)

    def change(self, action: str, statement: Statement, **values: Any) -> int:
        """The same; the number of rows that it inserted, updated or deleted."""
        with self._use() as ledger:
            return ledger.change(action, statement, **values)

    @contextmanager
    def transaction(self, action: str, lock: Lock | None = None) -> Iterator[SqliteConnection]:
        """A transaction that is committed at the end of the block, and undone if it raises.

        A ValueError or TypeError in the block counts as damage: it has read a value that was never written.
        """
        with self._use() as ledger, ledger.transaction(action) as connection:
            yield connection

    @contextmanager
    def _use(self) -> Iterator[SqliteLedger]:
        with self._lock:
            try:
                if self._opened is None:
                    self._opened = SqliteLedger.open(self._file, replace_damaged=True)
                yield self._opened
            except (Damage, ValueError, TypeError) as damage:
                self.close()
                with disk_errors(f"put {self._file.path.name} aside"):
                    self._file.put_aside(damage)
                raise Replaced(f"{self._file.path.name} was damaged and begins anew: try again.") from damage

    def close(self) -> None:
        """Write the log back and close the file."""
        with self._lock:
            opened, self._opened = self._opened, None
            if opened is not None:
                opened.close()
