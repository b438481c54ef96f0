"""The parts that a campaign kills of a cluster with a Milvus."""

from __future__ import annotations

from contextlib import closing

import numpy as np
from pymilvus import MilvusClient

from core.milvus.collection import collection_name, milvus_errors
from tests.core.cluster.clients import Addresses
from tests.core.cluster.parts import KillableCluster, KilledClient, KilledPostgres, KilledServer, SilentPostgres
from tests.core.storage.frames import DIMENSION, ENCODER
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


MILVUS = KillableCluster(
    running_servers,
    lambda servers: Addresses(servers.postgres_address, servers.milvus_address),
    {
        "milvus": lambda servers, _: KilledMilvus(servers),
        "postgres": lambda servers, _: KilledPostgres(servers.postgres),
        "silence": lambda servers, _: SilentPostgres(servers.postgres),
        "client": lambda _, client: KilledClient(client),
    },
)
