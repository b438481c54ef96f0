"""A service that shares its state with no other one."""

from __future__ import annotations

from collections.abc import Callable

from core.ledger import LedgerConnection
from service.peers.peers import Heard


class Alone:
    """The only service of a data directory (:class:`service.peers.peers.Peers`)."""

    id, alone, living = "alone", True, True

    def __init__(self) -> None:
        self._heard: dict[str, Heard] = {}

    def every(self, task: Callable[[], None]) -> None:
        """Do nothing: there is no other service to keep up with."""

    def hear(self, topic: str, heard: Heard) -> None:
        """Call a function with the messages of this service on a topic, in the thread that sends them."""
        self._heard[topic] = heard

    def say(self, topic: str, text: str = "") -> None:
        """Send a message to this service."""
        if topic in self._heard:
            self._heard[topic](text)

    def living_ids(self, connection: LedgerConnection) -> list[str]:
        """The id of this service."""
        return [self.id]
