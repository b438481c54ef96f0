"""The interface between a service and those with which it shares its state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from core.ledger import LedgerConnection

Heard = Callable[[str | None], None]
"""Called with a message; None: the connection was lost for a while, so any message may have been missed."""


class Peers(Protocol):
    """One service among those that share its state.  Any thread may use it."""

    @property
    def id(self) -> str:
        """The id of this service, the same after a restart."""

    @property
    def alone(self) -> bool:
        """Whether there is no other service, now or later, that writes to the same ledger."""

    @property
    def living(self) -> bool:
        """Whether the others still count this service as there."""

    def every(self, task: Callable[[], None]) -> None:
        """Do something at intervals of some seconds, in a thread, to keep up with other services."""

    def hear(self, topic: str, heard: Heard) -> None:
        """Call a function with the messages of services on a topic, in a thread or before :meth:`say` returns."""

    def say(self, topic: str, text: str = "") -> None:
        """Send a message to all services, this one included; it is not stored for those that are not connected.

        Raises:
            StorageFailure: the database cannot be reached, or refuses.
        """

    def living_ids(self, connection: LedgerConnection) -> list[str]:
        """The ids of the services that are there, within a transaction of the database that they share."""
