"""The interface of a ledger to those who keep records in it, whatever database it is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from enum import IntEnum
from typing import Any, Protocol

from core.ledger.statements import DialectName, Statement


class Lock(IntEnum):
    """The numbers by which transactions of several services wait for one another; nothing else may use them."""

    MAPS = 7_061_636_572
    TABLES = 7_061_636_573
    SESSIONS = 7_061_636_574
    JOBS = 7_061_636_575


class LedgerConnection(Protocol):
    """A connection for one thread, within a transaction or not."""

    @property
    def dialect(self) -> DialectName: ...

    def execute(self, statement: Statement, **values: Any) -> list[tuple[Any, ...]]:
        """Execute a statement; the rows that it gives."""

    def pages(self, statement: Statement, size: int, **values: Any) -> Iterator[list[tuple[Any, ...]]]:
        """Execute a statement; the rows that it gives, up to ``size`` at a time, within a transaction."""

    def execute_many(self, statement: Statement, values: Sequence[Mapping[str, Any]]) -> None:
        """Execute a statement once for each of some sets of values."""

    def change(self, statement: Statement, **values: Any) -> int:
        """Execute a statement; the number of rows that it inserted, updated or deleted."""


class Ledger(Protocol):
    """A database.  Any thread may use it.

    Every method may raise StorageFull or StorageFailure (StoreUnavailable of a server that cannot be reached); the
    ``action`` is the work of the block, for the message.
    """

    def execute(self, action: str, statement: Statement, **values: Any) -> list[tuple[Any, ...]]:
        """Execute one statement, which is durable when this returns; the rows that it gives."""

    def change(self, action: str, statement: Statement, **values: Any) -> int:
        """The same; the number of rows that it inserted, updated or deleted."""

    def transaction(self, action: str, lock: Lock | None = None) -> AbstractContextManager[LedgerConnection]:
        """A transaction that is committed, durably, at the end of the block, and undone if it raises.

        Args:
            lock: only one transaction with it runs at a time, over all services.
        """

    def close(self) -> None:
        """Close all connections."""
