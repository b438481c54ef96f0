"""The parts that a campaign kills of a cluster with a Milvus and an object store."""

from __future__ import annotations

from contextlib import closing
from hashlib import sha256

import numpy as np
from core.milvus.collection import collection_name, milvus_errors
from core.postgres.pictures.objects import Objects
from pymilvus import MilvusClient

from core.errors import StorageFailure
from core.ledger.maps.frames import StoredObject
from tests.core.cluster.clients import Addresses
from tests.core.cluster.parts import KillableCluster, KilledClient, KilledPostgres, KilledServer, SilentPostgres
from tests.core.store.frames import DIMENSION, ENCODER
from tests.servers.milvus import Servers, running_servers


class KilledMilvus(KilledServer):
    """Asked for a search that sees all that was written, which is the last thing that it can do again.

    When it has read its log, Milvus notes once a minute from where it would have to read it again; 2.3 has no setting
    for that.  Killed again before, it reads at each start what it has read at all starts since.
    """

    lives = 75.0

    def __init__(self, servers: Servers) -> None:
        super().__init__(servers.milvus)
        self._address = servers.milvus_address

    def ask(self) -> None:
        name, query = collection_name(ENCODER, DIMENSION), [np.ones(DIMENSION, np.float32)]
        with milvus_errors("answer"), closing(MilvusClient(self._address, timeout=1, dedicated=True)) as client:
            client.search(name, query, limit=1, timeout=2, anns_field="descriptor", consistency_level="Strong")


class KilledObjectStore(KilledServer):
    """Asked to write an object and to read it."""

    def __init__(self, servers: Servers) -> None:
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


MILVUS = KillableCluster(
    running_servers,
    lambda servers: Addresses(servers.postgres_address, servers.milvus_address, servers.bucket),
    {
        "milvus": lambda servers, _: KilledMilvus(servers),
        "postgres": lambda servers, _: KilledPostgres(servers.postgres),
        "silence": lambda servers, _: SilentPostgres(servers.postgres),
        "objects": lambda servers, _: KilledObjectStore(servers),
        "client": lambda _, client: KilledClient(client),
    },
)
