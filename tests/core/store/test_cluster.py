"""What the contract of all stores leaves open: several clients at the same time, versions, servers that are gone."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import psycopg
import pytest
from core.postgres import rows
from core.postgres.map import PostgresMap

from core.errors import MapExists, StoreOfAnotherVersion, StoreUnavailable, UnknownPlace
from core.ledger.maps import frames
from core.maps import MapSettings
from core.maps.archives.reading import Archive
from core.store import Directory
from core.store.cluster import Cluster
from tests.core.maps.mixed import check_one_kind_wins
from tests.core.maps.moves import ID, check_a_refused_import_leaves_nothing
from tests.core.maps.writers import check_writers_lose_nothing
from tests.core.store.archives.conftest import filled
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame
from tests.servers.postgres import Postgres

pytestmark = [pytest.mark.postgres, pytest.mark.timeout(300)]


@pytest.fixture
def store(postgres: Postgres) -> Iterator[Cluster]:
    store = Cluster(postgres.address)
    yield store
    for one in store.records(None, 100)[0]:
        store.delete(one.id)
    store.close()


def made(store: Cluster) -> PostgresMap:
    return store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)


def execute(postgres: Postgres, query: str) -> list[tuple[object, ...]]:
    with psycopg.connect(postgres.address, autocommit=True) as connection:
        cursor = connection.execute(query.encode())
        return [] if cursor.description is None else cursor.fetchall()


@pytest.mark.thorough
def test_writers_at_the_same_time_lose_nothing(postgres: Postgres, store: Cluster) -> None:
    others = [Cluster(postgres.address) for _ in range(3)]
    check_writers_lose_nothing(store, others)
    for other in others:
        other.close()


def test_of_two_writers_of_both_kinds_of_coordinates_one_wins(postgres: Postgres, store: Cluster) -> None:
    made(store)
    other = Cluster(postgres.address)
    check_one_kind_wins(store.get("lab"), other.get("lab"))
    other.close()


def test_a_refused_import_leaves_nothing(store: Cluster, tmp_path: Path) -> None:
    check_a_refused_import_leaves_nothing(store, tmp_path)


def test_one_of_two_imports_under_one_id_is_refused(postgres: Postgres, store: Cluster, tmp_path: Path) -> None:
    here, file = Directory(tmp_path), tmp_path / "lab.tar"
    filled(here.create(ID, ENCODER, DIMENSION, MapSettings(), LOCAL_SHAPE)).exporter.write(file)
    here.close()
    other, both = Cluster(postgres.address), threading.Barrier(2)

    def meet(_places: int) -> None:
        both.wait(60)

    def take(into: Cluster) -> str:
        with Archive(file) as archive:
            try:
                into.import_map(archive, ID, lambda *_: None, lambda _: None, 10**6, meet)
            except MapExists:
                return "refused"
        return "made"

    with ThreadPoolExecutor(2) as pool:
        assert sorted(pool.map(take, (store, other))) == ["made", "refused"]
    assert store.unlisted() == {} and [one.id for one in store.records(None, 10)[0]] == [ID]
    assert store.verify(ID).ok
    other.close()


def test_others_wait_while_writes_are_paused(postgres: Postgres, store: Cluster) -> None:
    made(store).enrol([frame("a")])
    other = Cluster(postgres.address)
    written = threading.Event()

    def write() -> None:
        other.get("lab").enrol([frame("b")])
        written.set()

    thread = threading.Thread(target=write)
    lab = store.get("lab")
    with lab.paused_writes():
        thread.start()
        while not execute(postgres, "SELECT 1 FROM pg_locks WHERE locktype = 'advisory' AND NOT granted"):
            assert thread.is_alive()
        lab.enrol([frame("c")])  # whoever pauses the others may write
        assert not written.is_set() and [place.id for place in lab.places(None, 10)[0]] == ["a", "c"]
    thread.join(60)
    assert [place.id for place in lab.places(None, 10)[0]] == ["a", "c", "b"]
    other.close()


def test_rows_that_no_place_has_are_deleted_a_while_later(store: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = made(store)
    lab.enrol([frame("a"), frame("b")])
    lab.forget("a")
    lab.enrol([frame("b", "another picture")])

    def stored() -> tuple[set[int], set[int]]:
        with lab.viewing() as (connection, _):
            return set(rows.both_at(connection, range(9))), set(frames.pictures_at(connection, range(9)))

    assert stored() == ({0, 1, 2}, {0, 1, 2})  # a query that is under way may read them
    monkeypatch.setattr(rows, "LEFT_SECONDS", 0)
    lab.enrol([frame("c")])
    assert stored() == ({2, 3}, {2, 3})


@pytest.mark.parametrize("by", [-2, 1])
def test_tables_of_another_version(postgres: Postgres, store: Cluster, by: int) -> None:
    made(store)
    ((version,),) = execute(postgres, "SELECT version FROM placerec_tables WHERE part = 'maps'")
    assert isinstance(version, int)
    execute(postgres, f"UPDATE placerec_tables SET version = {version + by} WHERE part = 'maps'")
    later = Cluster(postgres.address)
    try:
        for ask in (lambda: later.get("lab"), later.check_writable):
            with pytest.raises(StoreOfAnotherVersion, match=f"version {version + by}, which this placerec does not"):
                ask()
    finally:
        execute(postgres, f"UPDATE placerec_tables SET version = {version} WHERE part = 'maps'")
    assert later.get("lab").record.id == "lab"
    later.close()


def test_a_postgres_that_is_gone() -> None:
    store = Cluster("postgresql://placerec@127.0.0.1:9/postgres")
    for ask in (lambda: store.get("lab"), store.check_writable, lambda: store.records(None, 10)):
        with pytest.raises(StoreUnavailable, match="PostgreSQL cannot be reached"):
            ask()
    store.close()


def test_erased_places_leave_no_row(postgres: Postgres, store: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = made(store)
    lab.enrol([frame(f"p{i}", sequence="monday" if i % 2 else None) for i in range(6)])
    lab.forget_sequence("monday")
    left = "SELECT count(*) FROM descriptors UNION ALL SELECT count(*) FROM pictures"
    assert execute(postgres, left) == [(6,), (6,)]  # a query may still need them
    monkeypatch.setattr(rows, "LEFT_SECONDS", 0)
    report = lab.erase()
    assert (report.rows, execute(postgres, left)) == (3, [(3,), (3,)])
    assert lab.erase().rows == 0 and lab.count_places() == 3


def test_erased_looks_leave_no_row(postgres: Postgres, store: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = made(store)
    lab.enrol([frame("p1"), frame("p2")])
    lab.enrol([replace(frame("one look"), id=f"p1/{'0' * 16}"), replace(frame("other look"), id=f"p2/{'1' * 16}")])
    follower = Cluster(postgres.address)
    assert follower.get("lab").snapshot().alive.sum() == 4 and follower.get("lab").thumbnail(f"p1/{'0' * 16}")
    lab.forget("p1")
    assert lab.forget_looks([f"p2/{'1' * 16}", "p2", f"p1/{'0' * 16}"]) == 1
    monkeypatch.setattr(rows, "LEFT_SECONDS", 0)
    left = " UNION ALL ".join(f"SELECT count(*) FROM {table}" for table in ("descriptors", "pictures", "keypoints"))
    assert (lab.erase().rows, execute(postgres, left)) == (3, [(1,), (1,), (1,)])
    # Another service neither finds nor shows them any more.
    there = follower.get("lab")
    assert there.snapshot().alive.sum() == 1 and there.all_looks(None, 10) == ([], None)
    for gone in (f"p1/{'0' * 16}", f"p2/{'1' * 16}"):
        with pytest.raises(UnknownPlace):
            there.thumbnail(gone)
    follower.close()
