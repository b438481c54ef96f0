from __future__ import annotations

from collections.abc import Iterator

import pytest

from core.ledger import Ledger, Tables
from core.ledger.maps import schema
from core.ledger.maps.connection import MapConnection
from tests.core.ledger.conftest import OpenLedger
from tests.core.ledger.maps.memory import MemoryMap
from tests.core.store.frames import frame

TABLES = Tables("map", 1, schema.METADATA, application_id=0x504C5243)


@pytest.fixture
def ledger(open_ledger: OpenLedger) -> Iterator[Ledger]:
    """A ledger of maps with another map in it, whose ids and rows are those of the tests; it must stay as it is."""
    made = open_ledger(TABLES)
    hall = MemoryMap(made, "hall")
    hall.enrol([frame(f"p{i}", sequence="monday", metadata={"v": 1, "floor": i}) for i in range(3)])
    hall.cameras.put("front", None)
    before = hall.content()
    yield made
    assert hall.content() == before


@pytest.fixture
def lab(ledger: Ledger) -> MemoryMap:
    """A new map without places."""
    return MemoryMap(ledger, "lab")


@pytest.fixture
def connection(lab: MemoryMap) -> Iterator[MapConnection]:
    """A connection to a new map, in one transaction of the test."""
    with lab._reading() as connection:
        yield connection
