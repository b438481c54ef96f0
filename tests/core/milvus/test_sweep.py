"""What Milvus has and no place names is deleted, and what it lacks is noticed and given to it again."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from core.milvus import open_store
from core.milvus.map import MilvusMap
from core.milvus.store import MilvusStore
from core.postgres import rows
from pymilvus import MilvusClient

from core.errors import StorageFailure, StoreUnavailable
from core.ledger.maps import places, record
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame
from tests.servers.milvus import Servers

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]


@pytest.fixture
def store(servers: Servers) -> Iterator[MilvusStore]:
    store = open_store(servers.milvus_address, servers.postgres_address)
    yield store
    store.delete("swept")
    store.close()


@pytest.fixture
def lab(store: MilvusStore) -> MilvusMap:
    return store.create("swept", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)


def keys_in_milvus(store: MilvusStore, lab: MilvusMap) -> set[int]:
    """Those of the last keys that Milvus has."""
    with lab.viewing() as (connection, _):
        last = rows.last_key(connection.whole)
    return set(lab.collection.keys_between(max(0, last - 1000), last + 1))


def test_what_a_dead_write_left_is_deleted(store: MilvusStore, lab: MilvusMap, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.enrol([frame("a")])
    store.sweep()
    before = keys_in_milvus(store, lab)

    def die(*_: Any) -> None:
        raise StorageFailure("between the insertion and the COMMIT")

    with monkeypatch.context() as patched:
        patched.setattr(record, "put_counters", die)
        with pytest.raises(StorageFailure):
            lab.enrol([frame("b"), frame("c")])
    assert len(keys_in_milvus(store, lab) - before) == 2
    assert store.sweep() == 2
    assert keys_in_milvus(store, lab) == before and [place.id for place in lab.places(None, 10)[0]] == ["a"]


def test_what_is_being_written_stays(store: MilvusStore, lab: MilvusMap, monkeypatch: pytest.MonkeyPatch) -> None:
    put_counters, inserted, go_on = record.put_counters, threading.Event(), threading.Event()

    def slow(*args: Any) -> None:
        inserted.set()
        assert go_on.wait(60)
        put_counters(*args)

    swept: list[int] = []
    with monkeypatch.context() as patched:
        patched.setattr(record, "put_counters", slow)
        writer = threading.Thread(target=lambda: lab.enrol([frame("a")]))
        writer.start()
        assert inserted.wait(60)
        sweeper = threading.Thread(target=lambda: swept.append(store.sweep()))
        sweeper.start()
        sweeper.join(0.3)  # whether it has come to the lock by then or not
        go_on.set()
        writer.join(60)
        sweeper.join(60)
    assert swept == [0]
    ((found, _),) = lab.scope().search(descriptor_of("a")[np.newaxis])
    assert [place.id for place in lab.places_at(found.tolist()) if place] == ["a"]


def test_what_milvus_lost_is_noticed_and_restored(store: MilvusStore, lab: MilvusMap) -> None:
    lab.enrol([frame(f"p{number}") for number in range(3)])
    assert store.verify("swept").ok
    with lab.viewing() as (connection, _):
        key = places.expect(connection, "p1").key
    assert key is not None
    lab.collection.delete([key])
    report = store.verify("swept")
    assert not report.ok and "'p1' is missing" in report.problems[0]
    lab.rebuild_index()
    assert store.verify("swept").ok
    ((found, _),) = lab.scope().search(descriptor_of("p1")[np.newaxis])
    assert [place.id for place in lab.places_at(found[:1].tolist()) if place] == ["p1"]


def test_a_milvus_that_does_not_have_the_descriptors(servers: Servers, store: MilvusStore, lab: MilvusMap) -> None:
    """As one of two services sees it that is connected to another Milvus, or all see it if Milvus has lost its data."""
    lab.enrol([frame("a"), frame("b")])
    administrator = MilvusClient(servers.milvus_address)
    administrator.create_database("elsewhere")
    other = open_store(servers.milvus_address, servers.postgres_address, database="elsewhere")
    there = other.get("swept")
    query = descriptor_of("a")[np.newaxis]
    for ask in (lambda: there.scope().search(query), lambda: there.enrol([frame("c")])):
        with pytest.raises(StoreUnavailable, match="not the one that has the map's descriptors"):
            ask()
    with pytest.raises(StoreUnavailable, match="Milvus has no map's descriptors"):
        other.check_writable()
    assert other.sweep() == 0

    def first(of: MilvusMap) -> list[str]:
        ((found, _),) = of.scope().search(query)
        return [place.id for place in of.places_at(found[:1].tolist()) if place is not None]

    store.check_writable()
    assert first(lab) == ["a"] and lab.count_places() == 2
    there.rebuild_index()
    assert first(there) == ["a"]
    with pytest.raises(StoreUnavailable, match="not the one that has the map's descriptors"):
        first(lab)
    lab.rebuild_index()
    assert first(lab) == ["a"]
    other.close()
    MilvusClient(servers.milvus_address, db_name="elsewhere").drop_collection(there.collection.name)
    administrator.drop_database("elsewhere")
