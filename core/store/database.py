"""The interface of what keeps one map: an SQLite file, or rows of a PostgreSQL."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol

from core.ledger.maps.connection import MapConnection


class Closed(Exception):
    """The database of a map was closed before this use of it."""


class MapDatabase(Protocol):
    """The database of one map.  Any thread may use it.

    Every method may raise Closed, core.disk.files.Damage, StorageFull and StorageFailure.

    name: of the database, for messages.
    shared: whether others than this object may write to the map.
    """

    name: str
    shared: bool

    def reading(self) -> AbstractContextManager[MapConnection]:
        """A transaction that sees the moment of its first statement, and writes nothing."""

    def glancing(self) -> AbstractContextManager[MapConnection]:
        """A connection for single statements, each of which sees its own moment."""

    def fresh(self) -> AbstractContextManager[MapConnection]:
        """A connection that is waited for by nobody who waits for this thread."""

    def writing(self, alone: bool = True) -> AbstractContextManager[MapConnection]:
        """A transaction that is committed, durably, at the end of the block, and undone if it raises.

        Args:
            alone: nobody else writes places meanwhile, nor while this thread is in :meth:`paused`.
        """

    def paused(self) -> AbstractContextManager[None]:
        """Nobody but this thread writes places during the block."""

    def room(self) -> int | None:
        """The bytes that the map takes on the disk; None where only a server knows."""

    def give_back(self) -> None:
        """Give the disk room that deletions have freed, where it has little left."""

    def erase(self) -> int:
        """Have nothing left on the disk of what was deleted; returns the bytes by which it got smaller.

        Raises:
            MapBusy: it is being read.
        """

    def check(self, *tables: str) -> list[str]:
        """What the database itself finds damaged in some tables; none: in all, and in what is free."""
