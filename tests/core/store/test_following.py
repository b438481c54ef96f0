"""What a service holds of a map in its memory is what the database has, whoever writes and whatever is restored."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np
import psycopg
import pytest

from core.errors import StoreUnavailable, UnknownPlace
from core.maps.records import COMPACT_FROM, Enrolment, MapSettings, TierSetting
from core.maps.selection import Conditions, Selection
from core.places import PlaceFields, Pose
from core.store import Map, following
from core.store.cluster import Cluster
from core.store.rows import RowCache
from tests.servers.postgres import Postgres
from tests.service.wire import eventually

pytestmark = [pytest.mark.postgres, pytest.mark.timeout(600)]

Answered = TypeVar("Answered")

DIMENSION, LOCAL = 64, (4, 8)


def frame(place_id: str, seed: int, **fields: Any) -> Enrolment:
    """A frame with random descriptors."""
    random = np.random.default_rng(seed)
    descriptor = random.standard_normal(DIMENSION).astype(np.float32)
    local = random.integers(-127, 128, LOCAL).astype(np.int8)
    digest = seed.to_bytes(32, "big")
    return Enrolment(place_id, PlaceFields(**fields), descriptor / np.linalg.norm(descriptor), 3, digest, local)


@pytest.fixture
def empty(postgres: Postgres) -> Postgres:
    postgres.empty()
    return postgres


@pytest.fixture
def stores(empty: Postgres) -> Iterator[list[Cluster]]:
    """Two services."""
    opened = [Cluster(empty.address) for _ in range(2)]
    opened[0].create("lab", "encoder@1", DIMENSION, MapSettings(), LOCAL)
    yield opened
    for store in opened:
        store.close()


def maps_of(stores: list[Cluster]) -> list[Map]:
    return [store.get("lab") for store in stores]


def expect_alike(one: Map, address: str) -> None:
    """A map is what a service that has just started reads."""
    fresh = Cluster(address)
    try:
        (other,) = maps_of([fresh])
        held = one.snapshot()
        assert other.index_status().state == "unopened"
        read = other.snapshot()
        assert (len(held), held.rows) == (len(read), read.rows) and (held.alive == read.alive).all()
        rows = np.flatnonzero(read.alive)
        for name, column in vars(read.whereabouts.take(rows)).items():
            np.testing.assert_array_equal(column, getattr(held.whereabouts.take(rows), name), err_msg=name)
        np.testing.assert_array_equal(held.descriptors_at(rows), read.descriptors_at(rows))
        np.testing.assert_array_equal(held.locals_at(rows), read.locals_at(rows))
        assert (held.holds, held.table is None) == (read.holds, read.table is None)
        if held.table is not None and read.table is not None:
            codes = held.table.codes(0, held.rows), read.table.codes(0, read.rows)
            np.testing.assert_array_equal(codes[0][rows], codes[1][rows])
    finally:
        fresh.close()


@pytest.mark.thorough
@pytest.mark.parametrize("places", [20, 400])
def test_each_change_is_seen_by_the_next_search_of_another_service(
    stores: list[Cluster], empty: Postgres, places: int
) -> None:
    here, there = maps_of(stores)
    here.enrol([frame(f"p{number}", number + 1, sequence="walk") for number in range(places)])
    for number in (0, places - 1):
        query = frame("q", number + 1).descriptor[np.newaxis]
        ((rows, _),) = there.scope().search(query)
        found = there.places_at(rows.tolist()[:1])[0]
        assert found is not None and found.id == f"p{number}"
    assert there.index_status().tier == ("exact" if places < COMPACT_FROM else "compact")
    before = there.snapshot()
    assert there.snapshot() is before  # nothing was written: nothing is read
    there.patch("p3", {"pose": {"x": 1.0, "y": 2.0}})
    here.forget("p4")
    there.enrol([frame("p5", 9001, sequence="walk"), frame("new", 9002, pose=Pose(x=5, y=5))])  # one is replaced
    here.set_fields("p6", PlaceFields(sequence="another"))
    assert len(there.snapshot()) == places
    for service in (here, there):
        expect_alike(service, empty.address)
        near = Selection(Conditions(sequences=("another",)))
        ((rows, _),) = service.scope(near).search(frame("q", 7).descriptor[np.newaxis])
        assert [place and place.id for place in service.places_at(rows.tolist())] == ["p6"]
    assert before.alive[4] and len(before) == places  # a snapshot does not change


@pytest.mark.thorough
def test_a_map_that_grows_gets_codes_and_one_that_shrinks_loses_them(stores: list[Cluster], empty: Postgres) -> None:
    here, there = maps_of(stores)
    here.enrol([frame(f"p{number}", number + 1) for number in range(250)])
    assert there.snapshot().table is None
    here.enrol([frame(f"q{number}", number + 1000) for number in range(10)])
    assert there.snapshot().table is not None
    expect_alike(there, empty.address)
    for number in range(150):
        here.forget(f"p{number}")
    assert there.snapshot().table is None
    expect_alike(there, empty.address)


@pytest.mark.thorough
@pytest.mark.parametrize("index", ["auto", "compact"])
def test_commits_of_two_services_that_take_turns_as_they_like(
    stores: list[Cluster], empty: Postgres, index: TierSetting
) -> None:
    first, second = maps_of(stores)
    first.edit({"index": index})
    first.enrol([frame(f"p{number}", number + 1, sequence="walk") for number in range(300)])
    failures: list[BaseException] = []

    def work(map_: Map, seed: int) -> None:
        random = np.random.default_rng(seed)
        try:
            for step in range(40):
                number = int(random.integers(300))
                match random.integers(4):
                    case 0:
                        map_.enrol([frame(f"s{seed}-{step}", 10_000 * seed + step)])
                    case 1:
                        map_.enrol([frame(f"p{number}", 100_000 * seed + step, sequence="walk")])
                    case 2:
                        with suppress(UnknownPlace):
                            map_.patch(f"p{number}", {"pose": {"x": float(step), "y": float(seed)}})
                    case _:
                        with suppress(UnknownPlace):
                            map_.forget(f"p{number}")
                snapshot = map_.snapshot()
                assert int(np.count_nonzero(snapshot.alive)) == len(snapshot)
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(map_, seed)) for seed, map_ in enumerate((first, second, first), 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures
    for service in (first, second):
        expect_alike(service, empty.address)
    assert stores[0].verify("lab").ok


def test_a_reading_that_began_earlier_does_not_set_back_what_is_held(stores: list[Cluster]) -> None:
    here, there = maps_of(stores)
    here.enrol([frame(f"p{number}", number + 1) for number in range(300)])
    there.snapshot()
    with there.viewing() as (connection, state):
        here.enrol([frame("later", 5001)])
        newest = there.snapshot()
        assert len(newest) == 301
        assert there._followed.up_to_date(connection, state).snapshot is newest
    assert there.snapshot() is newest


def sent_again(request: Callable[[], Answered]) -> Answered:
    """The result of a request that is sent again as long as it is refused because a connection was lost."""
    results: list[Answered] = []

    def is_answered() -> bool:
        with suppress(StoreUnavailable):
            results.append(request())
        return bool(results)

    assert eventually(is_answered, 300)
    return results[0]


def swap_databases(server: Postgres, away: str, back: str) -> None:
    """Put a copy of the database, made before, in its place."""
    with psycopg.connect(server.address.replace("/postgres", "/template1"), autocommit=True) as connection:
        connection.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname IN ('postgres', %s)", (back,)
        )
        connection.execute(f"ALTER DATABASE postgres RENAME TO {away}")
        connection.execute(f"ALTER DATABASE {back} RENAME TO postgres")


@pytest.mark.thorough
@pytest.mark.parametrize("index", ["auto", "compact"])
def test_a_restore_to_an_earlier_moment_forgets_all_that_was_held(
    stores: list[Cluster], empty: Postgres, index: TierSetting
) -> None:
    here, there = maps_of(stores)
    here.edit({"index": index})
    here.enrol([frame(f"p{number}", number + 1) for number in range(300)])
    there.snapshot()
    with psycopg.connect(empty.address.replace("/postgres", "/template1"), autocommit=True) as connection:
        query = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = 'postgres'"
        connection.execute(query)
        connection.execute("CREATE DATABASE earlier TEMPLATE postgres")
    sent_again(lambda: here.enrol([frame("lost", 5001)]))
    row = sent_again(lambda: there.rows_of(["lost"]))[0]
    assert row == 300
    lost = there.snapshot().descriptors_at(np.array([row]))  # cached from now on
    swap_databases(empty, "later", "earlier")
    try:
        # The same number of writes as before: the revision is the same, its stamp is not.
        sent_again(lambda: here.enrol([frame("other", 5002)]))
        for _ in range(5):
            sent_again(there.count_places)
        assert sent_again(lambda: there.rows_of(["lost", "other"])) == [None, row]
        found = there.snapshot().descriptors_at(np.array([row]))
        assert not np.allclose(found, lost) and np.allclose(found[0], frame("other", 5002).descriptor, atol=1e-3)
        for service in (here, there):
            expect_alike(service, empty.address)
    finally:
        with psycopg.connect(empty.address.replace("/postgres", "/template1"), autocommit=True) as connection:
            connection.execute("DROP DATABASE later")


def test_codes_are_read_and_not_computed_and_made_again_where_they_are_damaged(
    stores: list[Cluster], empty: Postgres, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = maps_of(stores)
    here.enrol([frame(f"p{number}", number + 1) for number in range(300)])
    with psycopg.connect(empty.address) as connection:
        connection.execute("UPDATE codes SET bytes = set_byte(bytes, 0, get_byte(bytes, 0) # 255) WHERE row = 7")
        connection.execute("DELETE FROM codes WHERE row = 8")
    computed, encode = [], following.FollowedMap._encode

    def encoded(self: following.FollowedMap, *arguments: Any) -> None:
        computed.append(arguments[3])
        encode(self, *arguments)

    monkeypatch.setattr(following.FollowedMap, "_encode", encoded)
    snapshot = there.snapshot()
    assert computed == [[7, 8]]
    assert snapshot.table is not None
    right = snapshot.table.coder.encode(snapshot.descriptors_at(np.arange(300)))
    np.testing.assert_array_equal(snapshot.table.codes(0, 300), right)
    report = stores[0].verify("lab")
    assert report.ok and "p7" in report.stale_caches[0] and "rebuild the index" in report.stale_caches[0]
    there.rebuild_index()
    report = stores[0].verify("lab")
    assert report.ok and not report.stale_caches
    expect_alike(there, empty.address)


def test_rows_are_read_once_and_the_cache_stays_within_its_bytes(stores: list[Cluster]) -> None:
    here, there = maps_of(stores)
    here.edit({"index": "compact"})
    here.enrol([frame(f"p{number}", number + 1) for number in range(300)])
    snapshot = there.snapshot()
    assert not snapshot.holds
    cache = stores[1]._cache
    before = cache.misses
    snapshot.locals_at(np.arange(50))
    misses, hits = cache.misses, cache.hits
    assert misses == before + 50
    snapshot.locals_at(np.arange(50))
    assert (cache.misses, cache.hits) == (misses, hits + 50)
    small = RowCache(1000)
    for number in range(100):
        small.put({number: bytes(100)})
        assert small.size <= 1000
    assert 0 < len(small) < 10 and not small.get([0]) and small.get([99])


def test_blocks_of_codes_are_joined_in_the_background(stores: list[Cluster], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("core.index.table.LOOSE_ROWS", 256)
    here, there = maps_of(stores)
    here.enrol([frame(f"p{number}", number + 1) for number in range(300)])
    done = threading.Event()
    join = following.FollowedMap._join

    def joined(self: following.FollowedMap) -> None:
        join(self)
        done.set()

    monkeypatch.setattr(following.FollowedMap, "_join", joined)
    there.snapshot()
    assert not there.snapshot().table.is_loose or done.wait(60)  # type: ignore[union-attr]
    query = frame("q", 5).descriptor[np.newaxis]
    ((rows, _),) = there.scope().search(query)
    assert rows[0] == 4
