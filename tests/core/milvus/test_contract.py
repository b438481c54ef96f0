"""The store of PostgreSQL and Milvus does what is asked of every store, while two clients of it take turns."""

from __future__ import annotations

from contextlib import suppress
from typing import ClassVar

import pytest
from core.milvus import Bucket, open_store
from core.milvus.store import MilvusStore
from hypothesis import settings
from hypothesis.stateful import run_state_machine_as_test

from core.errors import UnknownMap
from core.store import Map
from tests.core.maps.contract import MAP, StoreContract
from tests.servers.milvus import Servers

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]


class Cluster(StoreContract):
    """Two clients of real servers: what one writes, the other reads next."""

    servers: ClassVar[Servers]
    bucket: ClassVar[Bucket | None] = None

    def __init__(self) -> None:
        super().__init__()
        self.other = self.opened()
        with suppress(UnknownMap):
            self.other.delete(MAP)

    def opened(self) -> MilvusStore:
        return open_store(self.servers.milvus_address, self.servers.postgres_address, bucket=self.bucket)

    @property
    def map(self) -> Map:
        self.store, self.other = self.other, self.store
        return self.store.get(MAP)

    def teardown(self) -> None:
        self.store.close()
        self.other.close()


class ClusterWithObjects(Cluster):
    """The same, with pictures in an object store."""


@pytest.mark.parametrize(("kind", "examples"), [(Cluster, 15), (ClusterWithObjects, 10)])
def test_contract(servers: Servers, kind: type[Cluster], examples: int) -> None:
    Cluster.servers, ClusterWithObjects.bucket = servers, servers.bucket
    run_state_machine_as_test(kind, settings=settings(max_examples=examples, stateful_step_count=20, deadline=None))
