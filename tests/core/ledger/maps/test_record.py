"""Maps are made, found, listed, published and deleted by their rows, in either database."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from core.errors import MapExists, UnknownMap
from core.ledger import Ledger
from core.ledger.database import LedgerConnection
from core.ledger.maps import record, sequences
from core.ledger.maps.connection import MapConnection
from core.ledger.postgres import PostgresConnection
from tests.core.ledger.maps.memory import MemoryMap, record_of
from tests.core.store.frames import frame


@pytest.fixture
def whole(ledger: Ledger) -> Iterator[LedgerConnection]:
    """A connection to a ledger in which there is the map "hall", in one transaction of the test."""
    with ledger.transaction("test") as connection:
        yield connection


def names(connection: LedgerConnection) -> list[str]:
    return [one.id for one in record.records_after(connection, "", 10)]


def test_an_id_is_of_one_map(whole: LedgerConnection) -> None:
    number = record.create(whole, record_of("lab"))
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
    assert record.state_of(of_lab, "lab", locked=True).record == record_of("lab")
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


def test_a_changed_record_is_read_as_it_was_stored(lab: MemoryMap) -> None:
    made = lab.edit({"description": "of the Ünter den Linden", "same_place_radius": 7.5})
    assert lab.record == made and made.revision == 2
    with pytest.raises(UnknownMap), lab.ledger.transaction("look") as connection:
        record.state_of(MapConnection(connection, 99), "nobody")


def test_a_map_takes_all_of_its_rows_with_it(lab: MemoryMap) -> None:
    lab.enrol([frame("p0", sequence="s", metadata={"floor": 1})])
    lab.cameras.put("front", None)
    with lab._reading() as connection:
        if not isinstance(connection.whole, PostgresConnection):
            pytest.skip("the only map of an SQLite file goes with the file")
        record.delete_map(connection)
        with pytest.raises(UnknownMap):
            record.state_of(connection, "lab")
    assert not any(lab.content().values())
