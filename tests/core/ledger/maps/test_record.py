"""Maps are made, found, listed, published and deleted by their rows in a database of many maps."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from core.errors import MapExists, UnknownMap
from core.ledger.database import LedgerConnection
from core.ledger.maps import record, sequences
from core.ledger.maps.connection import MapConnection
from core.maps import MapRecord
from core.maps.forms import HALF
from core.store import Map, Store
from core.store.cluster import Cluster
from tests.core.ledger.maps.conftest import content
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame

pytestmark = pytest.mark.parametrize(
    "database", [pytest.param("postgresql", marks=pytest.mark.postgres)], indirect=True
)


def record_of(name: str) -> MapRecord:
    return MapRecord.new(name, ENCODER, DIMENSION, LOCAL_SHAPE, HALF, None)


@pytest.fixture
def whole(store: Store) -> Iterator[LedgerConnection]:
    """A connection to a database in which there is the map "hall", in one transaction of the test."""
    assert isinstance(store, Cluster)
    with store.database.transaction("test") as connection:
        yield connection


def names(connection: LedgerConnection) -> list[str]:
    return [one.id for one in record.records_after(connection, "", 10)]


def test_an_id_is_of_one_map(whole: LedgerConnection) -> None:
    made = record_of("lab")
    number = record.create(whole, made)
    assert record.find(whole, "lab").number == number and names(whole) == ["hall", "lab"]
    assert record.find(whole, "hall").number != number
    with pytest.raises(MapExists, match="There is already a map 'lab'"):
        record.create(whole, record_of("lab"))
    with pytest.raises(UnknownMap, match="There is no map 'nobody'"):
        record.find(whole, "nobody")
    assert record.is_taken(whole, "lab") and not record.is_taken(whole, "nobody")
    assert [one.id for one in record.records_after(whole, "hall", 10)] == ["lab"]
    assert [one.id for one in record.records_after(whole, "", 1)] == ["hall"]
    of_lab = MapConnection(whole, number)
    assert record.state_of(of_lab, "lab", locked=True).record == made
    assert sequences.ends(of_lab) == {None: 0}


def test_a_map_that_is_built_is_listed_when_it_is_published(whole: LedgerConnection) -> None:
    number = record.create(whole, record_of("lab"), listed=False)
    assert names(whole) == ["hall"] and record.unlisted(whole) == {"lab": number}
    assert record.unlisted(whole, untouched_seconds=3600) == {}
    with pytest.raises(MapExists, match="A map 'lab' is being made"):
        record.create(whole, record_of("lab"))
    with pytest.raises(UnknownMap):
        record.find(whole, "lab")
    other = record.create(whole, record_of("cellar"), name="cellar-1", listed=False)
    with pytest.raises(MapExists, match="There is already a map 'hall'"):
        record.publish(whole, other, "hall")
    record.publish(whole, other, "cellar")
    record.publish(whole, number, "lab")
    assert names(whole) == ["cellar", "hall", "lab"] and record.unlisted(whole) == {}
    with pytest.raises(UnknownMap, match="No map 'lab' is being made"):
        record.publish(whole, number, "lab")


def test_a_map_takes_all_of_its_rows_with_it(lab: Map) -> None:
    lab.enrol([frame("p0", sequence="s", metadata={"floor": 1})])
    lab.cameras.put("front", None)
    with lab._transaction() as connection:
        record.delete_map(connection)
        with pytest.raises(UnknownMap):
            record.state_of(connection, "lab")
    with pytest.raises(UnknownMap):
        content(lab)
