"""The parts of a cluster that a campaign kills.  Another part is a class here and a line in ``PARTS``."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from random import Random
from typing import Protocol

from tests.core.cluster.clients import ProcessClient
from tests.servers.postgres import Postgres
from tests.servers.process import Server

AWAY_SECONDS = 1.0
"""Between the kill of a server and its next start."""

SILENT_SECONDS = 5.0, 25.0
"""The shortest and the longest silence: within it, readers (10 s) and writers (20 s) give up, or do not."""


class ClusterPart(Protocol):
    """One thing that is killed, or falls silent, and comes back."""

    is_server: bool
    """Whether the bar on recovery is about it."""

    def kill(self, draw: Random) -> None:
        """End it by SIGKILL, or let it stand still for a time that is drawn."""

    def start(self) -> None:
        """Start it, unless it was only still."""

    def ask(self) -> None:
        """Ask it for what its clients need of it, past everything that the store does to spare it.

        Raises:
            StorageFailure: it does not do it yet.
        """


class KilledServer:
    """A server all of whose processes are killed."""

    is_server = True

    def __init__(self, server: Server) -> None:
        self._server = server

    def kill(self, _: Random) -> None:
        self._server.kill()
        time.sleep(AWAY_SECONDS)

    def start(self) -> None:
        """Start it, and wait until it answers at all."""
        self._server.start()


class KilledPostgres(KilledServer):
    """PostgreSQL, which does all or nothing when it answers again."""

    def ask(self) -> None:
        """It answered at its start."""


class SilentPostgres:
    """PostgreSQL all of whose processes stand still for a while, as on a machine that is paused."""

    is_server = True

    def __init__(self, server: Server) -> None:
        self._server = server

    def kill(self, draw: Random) -> None:
        self._server.stall(draw.uniform(*SILENT_SECONDS))

    def start(self) -> None:
        """It goes on by itself."""

    def ask(self) -> None:
        """It answers again at once."""


class KilledClient:
    """A client in a process of its own; it takes as long as Python does to start."""

    is_server = False

    def __init__(self, client: ProcessClient) -> None:
        self._client = client

    def kill(self, _: Random) -> None:
        self._client.kill()

    def start(self) -> None:
        self._client.start()

    def ask(self) -> None:
        """Its answers are what is waited for anyway."""


PARTS: Mapping[str, Callable[[Postgres, ProcessClient], ClusterPart]] = {
    "postgres": lambda postgres, _: KilledPostgres(postgres.server),
    "silence": lambda postgres, _: SilentPostgres(postgres.server),
    "client": lambda _, client: KilledClient(client),
}
"""By name; each is made of the server and the client that may be killed."""
