"""The parts of a cluster that a campaign kills.  Another part is a class here and a line in ``POSTGRES``."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from random import Random
from typing import Generic, Protocol, TypeVar

from tests.core.cluster.clients import Addresses, ProcessClient
from tests.servers.postgres import running_postgres
from tests.servers.process import Server

AWAY_SECONDS = 1.0
"""Between the kill of a server and its next start."""

SILENT_SECONDS = 5.0, 25.0
"""The shortest and the longest silence: within it, readers (10 s) and writers (20 s) give up, or do not."""

ServersT = TypeVar("ServersT")
"""The servers of a cluster."""


class ClusterPart(Protocol):
    """One thing that is killed, or falls silent, and comes back."""

    is_server: bool
    """Whether the bar on recovery is about it."""

    lives: float
    """Seconds for which it serves before it is killed again."""

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

    is_server, lives = True, 0.0

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

    is_server, lives = True, 0.0

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

    is_server, lives = False, 0.0

    def __init__(self, client: ProcessClient) -> None:
        self._client = client

    def kill(self, _: Random) -> None:
        self._client.kill()

    def start(self) -> None:
        self._client.start()

    def ask(self) -> None:
        """Its answers are what is waited for anyway."""


@dataclass(frozen=True)
class KillableCluster(Generic[ServersT]):
    """A kind of cluster: its servers, and its parts by name.

    running: starts the servers, which run as long as the block does.
    addresses: of them.
    parts: each is made of the servers and the client that may be killed.
    """

    running: Callable[[], AbstractContextManager[ServersT]]
    addresses: Callable[[ServersT], Addresses]
    parts: Mapping[str, Callable[[ServersT, ProcessClient], ClusterPart]]


POSTGRES = KillableCluster(
    running_postgres,
    lambda postgres: Addresses(postgres.address),
    {
        "postgres": lambda postgres, _: KilledPostgres(postgres.server),
        "silence": lambda postgres, _: SilentPostgres(postgres.server),
        "client": lambda _, client: KilledClient(client),
    },
)
