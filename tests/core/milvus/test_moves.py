"""A map that moves between the stores stays what it is: the same file, byte for byte, and the same answers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from core.milvus import open_store
from core.milvus.store import MilvusStore

from core.maps.forms import COMPRESSED
from tests.core.maps.moves import check_a_refused_import_leaves_nothing, check_moves
from tests.servers.milvus import Servers

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]


@pytest.fixture
def store(servers: Servers) -> Iterator[MilvusStore]:
    store = open_store(servers.milvus_address, servers.postgres_address)
    yield store
    store.close()


@pytest.mark.parametrize("precision", ["half", COMPRESSED])
def test_a_map_moves_there_and_back(store: MilvusStore, tmp_path: Path, precision: str) -> None:
    check_moves(store, tmp_path, precision)


def test_a_refused_import_leaves_nothing(store: MilvusStore, tmp_path: Path) -> None:
    check_a_refused_import_leaves_nothing(store, tmp_path)
