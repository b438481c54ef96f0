"""The store of PostgreSQL does what is asked of every store, while two clients of it take turns."""

from __future__ import annotations

from contextlib import suppress
from typing import ClassVar

import pytest
from hypothesis import settings
from hypothesis.stateful import run_state_machine_as_test

from core.errors import UnknownMap
from core.store import Map
from core.store.cluster import Cluster
from tests.core.maps.contract import MAP, StoreContract
from tests.servers.postgres import Postgres

pytestmark = [pytest.mark.postgres, pytest.mark.thorough, pytest.mark.timeout(600)]


class TwoServices(StoreContract):
    """Two clients of a real server: what one writes, the other reads next."""

    server: ClassVar[Postgres]

    def __init__(self) -> None:
        super().__init__()
        self.other = self.opened()
        with suppress(UnknownMap):
            self.other.delete(MAP)

    def opened(self) -> Cluster:
        return Cluster(self.server.address)

    @property
    def map(self) -> Map:
        self.store, self.other = self.other, self.store
        return self.store.get(MAP)

    def teardown(self) -> None:
        self.store.close()
        self.other.close()


def test_contract(postgres: Postgres) -> None:
    TwoServices.server = postgres
    run_state_machine_as_test(TwoServices, settings=settings(max_examples=15, stateful_step_count=20, deadline=None))
