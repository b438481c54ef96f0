"""Both stores do what is asked of every store."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import ClassVar

import pytest
from hypothesis import settings
from hypothesis.stateful import run_state_machine_as_test

from core.errors import UnknownMap
from core.store import Directory, Map, Store
from core.store.cluster import Cluster
from tests.core.maps.contract import MAP, StoreContract
from tests.servers.postgres import Postgres

MANY = settings(max_examples=15, stateful_step_count=20, deadline=None)


class DataDirectory(StoreContract):
    """A data directory with segments of four rows."""

    def __init__(self) -> None:
        super().__init__()
        self.directory = Path(tempfile.mkdtemp(prefix="placerec-contract-"))

    def opened(self) -> Store:
        return Directory(self.directory, rows_per_segment=4)

    def teardown(self) -> None:
        self.store.close()
        shutil.rmtree(self.directory)


class TwoServices(StoreContract):
    """Two clients of a real server, which take turns: what one writes, the other reads next."""

    server: ClassVar[Postgres]

    def __init__(self) -> None:
        super().__init__()
        self.other = self.opened()
        with suppress(UnknownMap):
            self.other.delete(MAP)

    def opened(self) -> Cluster:
        return Cluster(self.server.address, rows_per_segment=4)

    @property
    def map(self) -> Map:
        self.store, self.other = self.other, self.store
        return self.store.get(MAP)

    def teardown(self) -> None:
        self.store.close()
        self.other.close()


def test_a_data_directory() -> None:
    run_state_machine_as_test(DataDirectory, settings=MANY)


@pytest.mark.postgres
@pytest.mark.thorough
@pytest.mark.timeout(600)
def test_two_services(postgres: Postgres) -> None:
    TwoServices.server = postgres
    run_state_machine_as_test(TwoServices, settings=MANY)
