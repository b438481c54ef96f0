"""Pictures in an object store: the same bytes wherever they are, and what happens when the store is gone, or full."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import obstore
import pytest
from core.postgres import rows
from core.postgres.map import PostgresMap
from core.postgres.pictures.bucket import Bucket
from core.postgres.pictures.objects import Objects

from core.errors import StorageFailure, StorageFull, StoreUnavailable
from core.ledger.maps import frames, places, record
from core.ledger.maps.frames import StoredObject
from core.maps import MapSettings, ReviewSetting
from core.maps.forms import COMPRESSED
from core.store.cluster import Cluster
from tests.core.maps.moves import check_moves
from tests.core.maps.review import check_pages_are_of_one_moment
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame
from tests.servers.object_store import reading_only, running_object_store
from tests.servers.postgres import Postgres

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]


@pytest.fixture
def store(postgres: Postgres, bucket: Bucket) -> Iterator[Cluster]:
    store = Cluster(postgres.address, bucket)
    yield store
    for one in store.records(None, 100)[0]:
        store.delete(one.id)
    store.close()


@pytest.fixture
def lab(store: Cluster) -> PostgresMap:
    return store.create("lab", ENCODER, DIMENSION, MapSettings(keep="image"), LOCAL_SHAPE)


@pytest.fixture
def objects(bucket: Bucket) -> Iterator[Objects]:
    objects = Objects(bucket)
    yield objects
    objects.close()


def where(lab: PostgresMap, place_id: str) -> StoredObject:
    """Where the picture of a place is."""
    with lab.viewing() as (connection, _):
        row = places.expect(connection, place_id).row
        stored = frames.pictures_at(connection, [row])[row]
    assert isinstance(stored, StoredObject)
    return stored


def folder_of(store: Cluster) -> str:
    with store.database.reading() as connection:
        return rows.objects_folder(connection)


def names_in(objects: Objects, store: Cluster) -> set[str]:
    """All objects."""
    folder = folder_of(store)
    return {name for page in objects.names_after(folder, folder) for name in page}


def image_of(name: str) -> bytes:
    return f"image of {name}".encode()


@pytest.mark.parametrize("precision", ["half", COMPRESSED])
def test_a_map_with_objects_is_the_same_map(store: Cluster, tmp_path: Path, precision: str) -> None:
    check_moves(store, tmp_path, precision)


def test_the_room_of_objects_counts(lab: PostgresMap) -> None:
    lab.enrol([frame("a"), frame("b")])
    room = lab.storage_status()
    assert room.keypoints is not None
    assert room.database == len(image_of("a")) + len(image_of("b")) + room.keypoints.bytes


def test_old_pictures_stay_where_they_are(store: Cluster, lab: PostgresMap, postgres: Postgres) -> None:
    without = Cluster(postgres.address)
    before = without.get("lab")
    before.enrol([frame("old"), frame("replaced")])
    assert lab.picture("old") == image_of("old")
    lab.enrol([frame("new"), frame("replaced", "something else")])
    assert lab.picture("replaced") == image_of("something else") and where(lab, "new").size == len(image_of("new"))
    assert before.picture("old") == image_of("old")
    with pytest.raises(StorageFailure, match="configured without one"):
        before.picture("new")
    assert store.verify("lab").ok
    without.close()


def test_frames_for_review(store: Cluster, lab: PostgresMap, objects: Objects) -> None:
    setting = ReviewSetting(most_frames=2)
    store.sweep_objects()
    before = names_in(objects, store)
    assert [lab.review.keep(image_of(name), {}, setting) for name in "aabc"] == [True, False, True, True]
    kept = lab.review.page(None, 10).frames
    assert [lab.review.picture(one.number) for one in kept] == [image_of("c"), image_of("b")]
    store.sweep_objects()
    assert len(names_in(objects, store) - before) == 2
    lab.review.discard(kept[0].number)
    objects.delete(sorted(names_in(objects, store) - before))
    with pytest.raises(StorageFailure, match="damaged"):
        lab.review.picture(kept[1].number)


def test_a_page_for_review_is_of_one_moment(store: Cluster, lab: PostgresMap) -> None:
    check_pages_are_of_one_moment(lab.review, store.get("lab").review)


def test_lost_and_damaged_objects_are_reported(store: Cluster, lab: PostgresMap, objects: Objects) -> None:
    lab.enrol([frame(name) for name in ("whole", "lost", "damaged")])
    objects.delete([where(lab, "lost").name])
    objects.put({where(lab, "damaged").name: b"image of daMaged"})
    report = store.verify("lab")
    assert not report.ok and [text.split("'")[1] for text in report.problems] == ["lost", "damaged"]
    for name in ("lost", "damaged"):
        with pytest.raises(StorageFailure, match=f"'{name}' is missing in the object store, or damaged"):
            lab.picture(name)
    assert lab.picture("whole") == image_of("whole")


def test_pictures_go_after_their_rows(store: Cluster, lab: PostgresMap, objects: Objects) -> None:
    """Those of deleted places and maps, and those of writes that died, but none that is being written or exported."""
    lab.enrol([frame("stays"), frame("goes")])
    other = store.create("other", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    other.enrol([frame("goes-too")])
    stays, goes, too = where(lab, "stays").name, where(lab, "goes").name, where(other, "goes-too").name
    with lab.viewing() as (connection, _):
        last = rows.last_key(connection.whole)
    folder = folder_of(store)
    litter, later = f"{folder}/{last:016x}-dead", f"{folder}/{last + 1000:016x}-alive"
    objects.put({litter: b"?", later: b"?"})
    store.sweep_objects()
    assert {stays, goes, too, later} <= names_in(objects, store) and litter not in names_in(objects, store)

    with lab.exporter._keeping_objects():
        store.delete("other")
        assert store.sweep_objects() == 0 and too in names_in(objects, store)
    assert store.sweep_objects() == 1 and too not in names_in(objects, store)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("core.postgres.rows.LEFT_SECONDS", 0)
        lab.forget("goes")
    assert goes in names_in(objects, store)
    store.sweep_objects()
    assert goes not in names_in(objects, store)
    objects.delete([later])


def test_what_is_being_written_stays(
    store: Cluster, lab: PostgresMap, objects: Objects, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_counters, written, go_on = record.put_counters, threading.Event(), threading.Event()

    def slow(*args: object) -> None:
        written.set()
        assert go_on.wait(60)
        put_counters(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(record, "put_counters", slow)
    threads = [threading.Thread(target=work) for work in (lambda: lab.enrol([frame("a")]), store.sweep_objects)]
    threads[0].start()
    assert written.wait(60)
    threads[1].start()
    threads[1].join(0.3)  # whether it has come to the lock by then or not
    go_on.set()
    for thread in threads:
        thread.join(60)
    assert lab.picture("a") == image_of("a")


def refusing(bucket: Bucket) -> dict[str, tuple[Bucket, str]]:
    return {
        "nobody there": (
            replace(bucket, endpoint="http://127.0.0.1:9"),
            "cannot be reached, or fails: Connection refused",
        ),
        "wrong secret": (replace(bucket, secret_key="wrong"), "refuses the credentials.*SignatureDoesNotMatch"),
        "unknown key": (replace(bucket, access_key="nobody"), "refuses the credentials.*InvalidAccessKeyId"),
        "no bucket": (replace(bucket, address="s3://never-made"), "has no bucket 'never-made'"),
        "no certificate": (replace(bucket, certificate="/nowhere"), "cannot be reached.*No such file"),
        "only readable": (reading_only(bucket), "takes no pictures.*AccessDenied"),
    }


def test_a_store_that_refuses(lab: PostgresMap, postgres: Postgres, bucket: Bucket) -> None:
    """Each refusal says why; nothing is changed, nothing stays behind, and queries are answered."""
    lab.enrol([frame("a")])
    for name, (refused, why) in refusing(bucket).items():
        other = Cluster(postgres.address, refused)
        there = other.get("lab")
        with pytest.raises(StoreUnavailable, match=why):
            other.check_pictures()
        time.sleep(0.6)  # when it is asked again
        with pytest.raises(StoreUnavailable, match=why):
            there.enrol([frame("b"), frame("c")])
        other.check_writable()
        ((found, _),) = there.scope().search(descriptor_of("a")[np.newaxis])
        assert [place.id for place in there.places_at(found.tolist()) if place] == ["a"], name
        if name == "only readable":
            assert there.picture("a") == image_of("a")
        else:
            with pytest.raises(StoreUnavailable):
                there.picture("a")
        there.edit({"keep": "none"})
        there.enrol([frame("without")])
        there.forget("without")
        there.edit({"keep": "image"})
        other.close()
    assert lab.count_places() == 1 and lab.picture("a") == image_of("a")


def test_a_full_store(lab: PostgresMap, postgres: Postgres, tmp_path: Path) -> None:
    lab.enrol([frame("a")])
    little_room = "-volume.max=1", "-master.volumeSizeLimitMB=1"
    with running_object_store(tmp_path, *little_room) as bucket:
        other = Cluster(postgres.address, bucket)
        there = other.get("lab")
        large = np.random.default_rng(0).bytes(400_000)
        stored = []
        with pytest.raises((StorageFull, StoreUnavailable), match="takes no pictures: 500 Internal Server Error"):
            for number in range(10):
                there.enrol([replace(frame(f"b{number}"), image=large)])
                stored.append(f"b{number}")
        assert stored and [place.id for place in there.places(None, 100)[0]] == ["a", *stored]
        assert all(there.picture(name) == large for name in stored)
        with pytest.raises(StorageFailure, match="takes no pictures"):
            other.check_pictures()
        other.close()


@pytest.mark.parametrize(
    ("said", "kind"),
    [
        (
            "507 Insufficient Storage: <Error><Code>XMinioStorageFull</Code><Message>Disk is full.</Message>",
            StorageFull,
        ),
        ("403 Forbidden: <Error><Code>QuotaExceeded</Code><Message>No more.</Message></Error>", StorageFull),
        ("503 Service Unavailable: <Error><Code>SlowDown</Code></Error>", StoreUnavailable),
    ],
)
def test_what_other_stores_say(
    objects: Objects, monkeypatch: pytest.MonkeyPatch, said: str, kind: type[StorageFailure]
) -> None:
    def refuse(*_: object) -> None:
        raise obstore.exceptions.GenericError(
            f"Error performing PUT in 1ms - Server returned non-2xx status code: {said}"
        )

    with monkeypatch.context() as patched:
        patched.setattr(obstore, "put", refuse)
        with pytest.raises(kind, match="The object store takes no pictures"):
            objects.check()
    objects.check()
