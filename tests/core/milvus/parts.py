"""The parts of a cluster that a campaign kills.  Another part is a class here and a line in ``PARTS``."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from hashlib import sha256
from typing import Protocol

import numpy as np
from pymilvus import MilvusClient

from core.errors import StorageFailure
from core.ledger.maps.frames import StoredObject
from core.milvus.collection import collection_name, milvus_errors
from core.postgres.pictures.objects import Objects
from tests.core.milvus.clients import ProcessClient
from tests.core.storage.frames import DIMENSION, ENCODER
from tests.servers.milvus import Servers
from tests.servers.process import Server

AWAY_SECONDS = 1.0
"""Between the kill of a server and its next start."""


class Part(Protocol):
    """What is killed and started again."""

    is_server: bool
    """Whether the bar on recovery is about it."""

    lives: float
    """Seconds for which it serves before it is killed again."""

    def kill(self) -> None:
        """End it by SIGKILL."""

    def start(self) -> None:
        """Start it, and wait until it answers at all."""

    def ask(self) -> None:
        """Ask it for what its clients need of it, past everything that the store does to spare it.

        Raises:
            StorageFailure: it does not do it yet.
        """


class _OfServer:
    is_server, lives = True, 0.0

    def __init__(self, server: Server) -> None:
        self._server = server

    def kill(self) -> None:
        self._server.end(signal.SIGKILL)
        time.sleep(AWAY_SECONDS)

    def start(self) -> None:
        self._server.start()


class Postgres(_OfServer):
    def __init__(self, servers: Servers, _: ProcessClient) -> None:
        super().__init__(servers.postgres)

    def ask(self) -> None:
        """It answered at its start; it does all or nothing."""


class Milvus(_OfServer):
    """Asked for a search that sees all that was written, which is the last thing that it can do again.

    When it has read its log, Milvus notes once a minute from where it would have to read it again; 2.3 has no setting
    for that.  Killed again before, it reads at each start what it has read at all starts since.
    """

    lives = 75.0

    def __init__(self, servers: Servers, _: ProcessClient) -> None:
        super().__init__(servers.milvus)
        self._address = servers.milvus_address

    def ask(self) -> None:
        name, query = collection_name(ENCODER, DIMENSION), [np.ones(DIMENSION, np.float32)]
        with milvus_errors("answer"), closing(MilvusClient(self._address, timeout=1, dedicated=True)) as client:
            client.search(name, query, limit=1, timeout=2, anns_field="descriptor", consistency_level="Strong")


class ObjectStore(_OfServer):
    """Asked to write an object and to read it."""

    def __init__(self, servers: Servers, _: ProcessClient) -> None:
        super().__init__(servers.objects)
        self._bucket = servers.bucket

    def ask(self) -> None:
        content = b"asked"
        asked = StoredObject("asked", len(content), sha256(content).digest())
        objects = Objects(self._bucket)
        try:
            objects.put({asked.name: content})
            if objects.read([asked]) != [content]:
                raise StorageFailure("it does not read what it wrote")
        finally:
            objects.close()


class Client:
    """A client in a process of its own; it takes as long as Python does to start."""

    is_server, lives = False, 0.0

    def __init__(self, _: Servers, client: ProcessClient) -> None:
        self._client = client

    def kill(self) -> None:
        self._client.kill()

    def start(self) -> None:
        self._client.start()

    def ask(self) -> None:
        """Its answers are what is waited for anyway."""


PARTS: Mapping[str, Callable[[Servers, ProcessClient], Part]] = {
    "milvus": Milvus,
    "postgres": Postgres,
    "objects": ObjectStore,
    "client": Client,
}
