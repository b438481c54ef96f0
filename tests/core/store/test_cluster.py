"""What the contract of all stores leaves open of PostgreSQL: several services at the same time, versions, restores."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import psycopg
import pytest

from core.errors import MapExists, StorageFailure, StoreOfAnotherVersion, StoreUnavailable, UnknownPlace
from core.ledger.maps import frames, rows
from core.maps import MapSettings, ReviewSetting
from core.maps.archives.reading import Archive
from core.maps.forms import COMPRESSED
from core.store import Directory, Map
from core.store.cluster import Cluster
from tests.core.maps.mixed import check_one_kind_wins
from tests.core.maps.moves import ID, check_a_refused_import_leaves_nothing, check_moves
from tests.core.maps.review import check_pages_are_of_one_moment
from tests.core.maps.writers import check_writers_lose_nothing
from tests.core.store.archives.conftest import filled
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame
from tests.servers.postgres import Postgres

pytestmark = [pytest.mark.postgres, pytest.mark.timeout(300)]


@pytest.fixture
def store(postgres: Postgres) -> Iterator[Cluster]:
    store = Cluster(postgres.address)
    store.check_writable()  # makes the tables
    yield store
    store.close()
    execute(postgres, "DELETE FROM maps")


def made(store: Cluster) -> Map:
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


@pytest.mark.thorough
@pytest.mark.parametrize("precision", ["half", COMPRESSED])
def test_a_map_moves_from_and_to_a_data_directory(store: Cluster, tmp_path: Path, precision: str) -> None:
    check_moves(store, tmp_path, precision)


def test_a_page_for_review_is_of_one_moment(store: Cluster) -> None:
    check_pages_are_of_one_moment(made(store).review, store.get("lab").review)


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        ("DELETE FROM pictures WHERE row = 1", "is recorded to keep image, which is not true"),
        ("UPDATE pictures SET bytes = 'image of B' WHERE row = 1", "has a stored image that does not match its digest"),
        (
            "UPDATE pictures SET bytes = 'image of B', digest = sha256('image of B') WHERE row = 1",
            "has an image that does not match its digest",
        ),
    ],
    ids=["lost", "damaged", "another"],
)
def test_a_wrong_picture_is_reported(postgres: Postgres, store: Cluster, damage: str, problem: str) -> None:
    lab = store.create("lab", ENCODER, DIMENSION, MapSettings(keep="image"), LOCAL_SHAPE)
    lab.enrol([frame("a"), frame("b")])
    assert store.verify("lab").ok
    execute(postgres, damage)
    report = store.verify("lab")
    assert not report.ok and report.problems == [f"PostgreSQL: place 'b' {problem}"]
    assert lab.picture("a") == b"image of a" and store.quarantined() == {}


@pytest.mark.parametrize("damage", ["DELETE FROM review_pictures", "UPDATE review_pictures SET bytes = 'another'"])
def test_a_wrong_picture_for_review_is_not_shown(postgres: Postgres, store: Cluster, damage: str) -> None:
    review, setting = made(store).review, ReviewSetting(most_frames=2)
    assert [review.keep(one, {}, setting) for one in (b"one", b"one", b"two", b"three")] == [True, False, True, True]
    shown = [review.picture(one.number) for one in review.page(None, 10).frames]
    assert shown == [b"three", b"two"]
    execute(postgres, damage)
    for one in review.page(None, 10).frames:
        with pytest.raises(StorageFailure, match="damaged"):
            review.picture(one.number)


def test_damage_is_a_failure_of_each_use_and_not_of_the_map(postgres: Postgres, store: Cluster) -> None:
    lab = made(store)
    lab.enrol([frame("a"), frame("b")])
    store.close()
    later = Cluster(postgres.address)
    execute(postgres, "UPDATE descriptors SET bytes = set_byte(bytes, 0, get_byte(bytes, 0) # 1) WHERE row = 1")
    for _ in range(2):
        with pytest.raises(StorageFailure, match="Map 'lab' is damaged: row 1 of descriptors does not match"):
            later.get("lab").snapshot()
    assert later.quarantined() == {} and later.get("lab").place("b").id == "b"
    later.get("lab").forget("b")
    assert len(later.get("lab").snapshot()) == 1
    later.close()


def test_a_closed_store_refuses_the_maps_that_are_held(store: Cluster) -> None:
    lab = made(store)
    lab.enrol([frame("a")])
    held = lab.snapshot()
    store.close()
    for use in (lab.snapshot, lambda: lab.enrol([frame("b")]), lambda: lab.place("a"), lambda: store.get("lab")):
        with pytest.raises(StorageFailure, match="closed"):
            use()
    assert len(held) == 1


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
            return set(rows.at(connection, "descriptors", range(9))), set(frames.pictures_at(connection, range(9)))

    assert stored() == ({0, 1, 2}, {0, 1, 2})  # a query that is under way may read them
    monkeypatch.setattr(rows, "LEFT_SECONDS", -1)
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
    monkeypatch.setattr(rows, "LEFT_SECONDS", -1)
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
    monkeypatch.setattr(rows, "LEFT_SECONDS", -1)
    left = " UNION ALL ".join(f"SELECT count(*) FROM {table}" for table in ("descriptors", "pictures", "keypoints"))
    assert (lab.erase().rows, execute(postgres, left)) == (3, [(1,), (1,), (1,)])
    # Another service neither finds nor shows them any more.
    there = follower.get("lab")
    assert there.snapshot().alive.sum() == 1 and there.all_looks(None, 10) == ([], None)
    for gone in (f"p1/{'0' * 16}", f"p2/{'1' * 16}"):
        with pytest.raises(UnknownPlace):
            there.thumbnail(gone)
    follower.close()
