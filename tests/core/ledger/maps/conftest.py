"""A map in each of the two databases; PostgreSQL where it is installed."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import pytest
from sqlalchemy import bindparam, select

from core.ledger import Statement
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import MAPS, METADATA
from core.store import Map, Store
from tests.core.store.conftest import OpenStore, at_once, directory, lab, open_store
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame

__all__ = ["MOMENT", "at_once", "content", "directory", "lab", "open_store"]

MOMENT = datetime(2026, 11, 20, 10, tzinfo=UTC)

_CONTENT = {
    name: Statement(select(table).where((table.c.number if table is MAPS else table.c.map) == bindparam("map")))
    for name, table in METADATA.tables.items()
}


def content(map_: Map) -> dict[str, list[Any]]:
    """All rows of a map by table, in any order that is always the same."""
    with map_.viewing() as (connection, _):
        return {name: sorted(connection.execute(query), key=repr) for name, query in _CONTENT.items()}


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def database(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def store(open_store: OpenStore) -> Iterator[Store]:
    """A store with another map in it, whose ids and rows are those of the tests; it must stay as it is."""
    made = open_store()
    hall = made.create("hall", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    hall.enrol([frame(f"p{i}", sequence="monday", metadata={"v": 1, "floor": i}) for i in range(3)])
    hall.cameras.put("front", None)
    before = content(hall)
    yield made
    assert content(hall) == before


@pytest.fixture
def connection(lab: Map) -> Iterator[MapConnection]:
    """A connection to a new map, in one transaction of the test."""
    with lab._transaction() as connection:
        yield connection
