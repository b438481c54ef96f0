"""The table of keys, and what it needs where services share it: the count of changes by which they hear of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, ClassVar, Protocol

from sqlalchemy import Column, MetaData, Table, column, select, table, update

from core.errors import StorageFailure, StorageFull
from core.ledger import Ledger, LedgerConnection, Statement, Tables
from core.ledger.statements import binary, text
from service.errors.faults import KeysUnreadable

_METADATA = MetaData()
KEYS = Table(
    "keys",
    _METADATA,
    Column("id", text(), primary_key=True),
    Column("name", text(), nullable=False),
    Column("role", text(), nullable=False),
    Column("maps", text()),
    Column("digest", binary(), nullable=False),
    Column("created_at", text(), nullable=False),
    Column("expires_at", text()),
    Column("revoked_at", text()),
    Column("seal", binary(), nullable=False),
    Column("last_used_at", text()),
    sqlite_strict=True,
)
TABLES = Tables(
    "keys",
    1,
    _METADATA,
    application_id=0x706C6B79,  # "plky"
    more={
        "postgresql": [
            "CREATE TABLE key_changes (number bigint NOT NULL)",  # of one row
            "INSERT INTO key_changes VALUES (0)",
        ]
    },
)

_CHANGES = table("key_changes", column("number"))
_VERSION = Statement(select(_CHANGES.c.number))
_COUNT = Statement(update(_CHANGES).values(number=_CHANGES.c.number + 1))
_ANY = Statement(select(KEYS.c.id).limit(1))


class KeyPlace(Protocol):
    """A database that has the table of keys; any number of processes may use it.

    All methods may raise KeysUnreadable: the keys are damaged, of a later version or writable by others, or the disk or
    server failed.

    remote: whether it is on a server, which may be away for a while.
    """

    remote: ClassVar[bool]

    def exists(self) -> bool:
        """Whether keys are needed, because one was ever created."""

    def prepare(self) -> None:
        """Make room for the first key."""

    def execute(self, statement: Statement) -> list[tuple[Any, ...]]:
        """The rows that a statement reads; none if no key was ever created."""

    def changing(self, announced: bool = True) -> AbstractContextManager[LedgerConnection]:
        """A transaction during which nobody else changes keys; it is durable when the context ends.

        Args:
            announced: whether running services read the keys again after it.
        """

    def version(self, expected: bool) -> object:
        """A value that is another one after every change, for one thread; None if there are no keys.

        Args:
            expected: refuse if there are no keys any more.
        """

    def close(self) -> None:
        """Close what :meth:`version` has opened; the next one is another one."""


class KeyTable:
    """The keys that services share.  Any thread may use it.

    A change locks the count of changes, so that one comes after the other.
    """

    remote: ClassVar[bool] = True

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger

    def exists(self) -> bool:
        return bool(self.execute(_ANY))

    def prepare(self) -> None:
        """The ledger has made the table."""

    def execute(self, statement: Statement) -> list[tuple[Any, ...]]:
        with _refusals():
            return self._ledger.execute("use the keys", statement)

    @contextmanager
    def changing(self, announced: bool = True) -> Iterator[LedgerConnection]:
        with _refusals(), self._ledger.transaction("change the keys") as connection:
            if announced:
                connection.change(_COUNT)
            yield connection

    def version(self, expected: bool) -> object:
        ((number,),) = self.execute(_VERSION)
        return number

    def close(self) -> None:
        """The ledger is closed by its owner."""


@contextmanager
def _refusals() -> Iterator[None]:
    try:
        yield
    except (StorageFull, StorageFailure) as error:
        raise KeysUnreadable(f"The keys cannot be used: {error}") from error
