"""What the contract of all stores leaves open: large maps, writers at the same time, a Milvus that is gone."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from core.milvus import open_store
from core.milvus.map import MilvusMap
from core.milvus.snapshot import SHORTLIST
from core.milvus.store import MilvusStore

from core.errors import StoreUnavailable
from core.frames.images import encode_png
from core.judgement.priors import Disc, Facing
from core.ledger.maps.record import RECENT_SECONDS
from core.maps import MapSettings, Selection
from core.maps.records import COMPACT_FROM
from core.maps.selection import Conditions
from core.method.catalogue import EncoderCatalogue
from core.places import Neighborhood, Pose
from core.recognition import enrol, recognize
from core.recognition.question import Question
from core.store import Directory, Map
from tests.core.maps.writers import check_writers_lose_nothing
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame, stored_of
from tests.servers.milvus import Servers
from tests.service.encoders import TWO_STAGES, install_two_stage_encoder
from tests.service.scenes import jpeg, scene, seen_again
from tests.service.stores.door import Door

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]

PLACES = 2 * COMPACT_FROM


def connected(servers: Servers) -> MilvusStore:
    return open_store(servers.milvus_address, servers.postgres_address)


@pytest.fixture
def store(servers: Servers) -> Iterator[MilvusStore]:
    """An empty store."""
    store = connected(servers)
    for record in store.records(None, 100)[0]:
        store.delete(record.id)
    yield store
    store.close()


def made(store: MilvusStore, name: str = "lab") -> MilvusMap:
    return store.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)


def test_a_large_map(store: MilvusStore) -> None:
    lab = made(store)
    names = [f"p{number}" for number in range(PLACES)]
    lab.enrol([frame(name, x=10.0 * at, sequence="far" if at % 2 else "near") for at, name in enumerate(names)])
    every, asked = np.stack([stored_of(name) for name in names]), descriptor_of("asked")
    best = np.argsort(-(every @ asked))

    def found(selection: Selection | None = None) -> list[int]:
        scope = lab.scope(selection)
        ((rows, _),) = scope.search(asked[np.newaxis])
        return [int(place.id[1:]) for place in lab.places_at(rows.tolist()) if place is not None]

    assert found() == best[:SHORTLIST].tolist()
    within = Selection(filters=Conditions((Disc(Pose(x=1000, y=0), 95.0),)))
    assert sorted(found(within)) == list(range(91, 110))
    assert found(Selection(filters=Conditions((Facing(90.0, 5.0),)))) == []
    # A prior's places are found wherever they are in the ranking, and the others as well.
    last = int(best[-1])
    prior = Conditions((Disc(Pose(x=10.0 * last, y=0), 5.0),))
    assert last in found(Selection(prior=prior)) and int(best[0]) in found(Selection(prior=prior))

    scope = lab.scope()
    ((rows, products),) = scope.search(asked[np.newaxis])
    more, _ = scope.search_elsewhere(asked, (rows, products), int(rows[0]), Neighborhood(500.0, 3))
    assert len(more) == SHORTLIST and not set(more.tolist()) & set(rows.tolist())
    position = scope.snapshot.whereabouts_at(np.concatenate([rows[:1], more])).position[:, 0]
    assert (np.abs(position[1:] - position[0]) > 500).all()

    allowed = np.zeros(scope.snapshot.rows, np.bool_)
    allowed[rows[:7]] = True
    assert scope.snapshot.among(allowed).search(asked[np.newaxis])[0][0].tolist() == rows[:7].tolist()
    assert set(scope.snapshot.among(~allowed).search(asked[np.newaxis])[0][0].tolist()) >= set(rows[7:].tolist())


def test_a_map_answers_as_one_in_a_data_directory_does(store: MilvusStore, tmp_path: Path) -> None:
    install_two_stage_encoder(tmp_path / "models")
    encoder = EncoderCatalogue(tmp_path / "models").get(TWO_STAGES)
    atlas = Directory(tmp_path / "data")
    made = encoder.identity, encoder.dimension, MapSettings(verification=True), encoder.local_shape
    maps: list[Map] = [atlas.create("lab", *made), store.create("lab", *made)]
    for number in range(8):
        for map_ in maps:
            enrol(map_, f"p{number}", jpeg(number), encoder)
    for number in (3, 5, 99):
        picture = encode_png(seen_again(scene(number)))
        here, there = (recognize(map_, picture, encoder, Question(k=8, verify="always")) for map_ in maps)
        assert there.judgement.verdict == here.judgement.verdict
        assert [place.id for _, place in there.matches] == [place.id for _, place in here.matches]
        assert np.allclose([score for score, _ in there.matches], [score for score, _ in here.matches], atol=1e-5)
        assert there.third_stage.state == here.third_stage.state == "verified"
    atlas.close()


def test_writers_at_the_same_time_lose_nothing(servers: Servers, store: MilvusStore) -> None:
    others = [connected(servers) for _ in range(3)]
    check_writers_lose_nothing(store, others)
    for other in others:
        other.close()


def test_what_was_left_over_is_deleted(store: MilvusStore, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = made(store)
    lab.enrol([frame("a"), frame("b")])
    scope = lab.scope()
    ((rows, _),) = scope.search(descriptor_of("a")[np.newaxis])
    lab.forget("a")
    lab.enrol([frame("b", "another picture")])
    # A query that is under way reads what it has found.
    assert scope.snapshot.locals_at(rows).shape == (2, *LOCAL_SHAPE)
    assert len(scope.snapshot.whereabouts_at(rows)) == 2
    monkeypatch.setattr("core.postgres.rows.LEFT_SECONDS", 0)
    lab.enrol([frame("c")])
    assert lab.snapshot().orphans == ()
    assert len(lab.snapshot()) == 2


def test_a_milvus_that_is_gone(servers: Servers, store: MilvusStore) -> None:
    made(store).enrol([frame("a")])
    without_milvus = open_store("http://127.0.0.1:9", servers.postgres_address)
    lab = without_milvus.get("lab")
    assert lab.place("a").id == "a"
    with pytest.raises(StoreUnavailable, match="Milvus cannot be reached"):
        lab.scope().search(descriptor_of("a")[np.newaxis])
    with pytest.raises(StoreUnavailable, match="Milvus cannot be reached"):
        lab.enrol([frame("b")])
    assert [place.id for place in lab.places(None, 10)[0]] == ["a"]
    with pytest.raises(StoreUnavailable, match="Milvus"):
        without_milvus.check_writable()
    without_milvus.close()


def test_a_milvus_that_goes_away_and_comes_back(servers: Servers, store: MilvusStore) -> None:
    made(store).enrol([frame("a")])
    door = Door(servers.milvus_address)
    door.open()
    other = open_store(door.address, servers.postgres_address)
    query, scope = descriptor_of("a")[np.newaxis], other.get("lab").scope()
    assert len(scope.search(query)[0][0]) == 1
    door.shut()
    for _ in range(2):
        with pytest.raises(StoreUnavailable, match="Milvus cannot be reached"):
            scope.search(query)
    door.open()
    until = time.monotonic() + 30
    while True:
        try:
            assert len(scope.search(query)[0][0]) == 1
            break
        except StoreUnavailable:
            assert time.monotonic() < until
            time.sleep(0.1)
    other.close()


def test_a_write_is_seen_at_once_and_when_it_is_old(store: MilvusStore) -> None:
    lab = made(store)
    lab.enrol([frame("a")])
    assert lab.latest().recent and len(lab.scope().search(descriptor_of("a")[np.newaxis])[0][0]) == 1
    with lab.database.transaction("age the map") as whole:
        whole.driver.execute("UPDATE maps SET touched = touched - %s", (RECENT_SECONDS,))
    assert not lab.latest().recent and len(lab.scope().search(descriptor_of("a")[np.newaxis])[0][0]) == 1
    lab.enrol([frame("b")])
    assert lab.latest().recent and len(lab.scope().search(descriptor_of("a")[np.newaxis])[0][0]) == 2
