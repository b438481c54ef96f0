"""Pictures in an object store: the same bytes wherever they are, and what happens when the store is gone, or full."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import obstore
import pytest

from core.errors import StorageFailure, StorageFull, StoreUnavailable
from core.ledger.maps.frames import StoredObject
from core.maps import MapSettings, ReviewSetting
from core.milvus import Bucket, ledger, open_store
from core.milvus.map import MilvusMap
from core.milvus.store import MilvusStore
from core.postgres.pictures.objects import Objects
from core.storage import Atlas
from tests.core.maps.review import check_pages_are_of_one_moment
from tests.core.milvus.object_server import PORTS, object_store, reading_only
from tests.core.milvus.servers import Server, Servers, fixed_ports
from tests.core.milvus.test_moves import ID, imported
from tests.core.storage.archives.conftest import filled
from tests.core.storage.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]


def connected(servers: Servers, bucket: Bucket | None) -> MilvusStore:
    return open_store(servers.milvus_address, servers.postgres_address, bucket=bucket)


@pytest.fixture
def store(servers: Servers) -> Iterator[MilvusStore]:
    store = connected(servers, servers.bucket)
    yield store
    for record in store.records(None, 100)[0]:
        store.delete(record.id)
    store.close()


@pytest.fixture
def lab(store: MilvusStore) -> MilvusMap:
    return store.create("lab", ENCODER, DIMENSION, MapSettings(keep="image"), LOCAL_SHAPE)


@pytest.fixture
def objects(servers: Servers) -> Iterator[Objects]:
    objects = Objects(servers.bucket)
    yield objects
    objects.close()


def where(lab: MilvusMap, place_id: str) -> StoredObject:
    """Where the picture of a place is."""
    with lab.viewing() as (connection, _):
        entry = ledger.find(connection, lab.number, place_id)
        assert entry is not None
        kept = ledger.pictures_of(connection, lab.number, [entry.row])[entry.row]
    assert isinstance(kept, StoredObject)
    return kept


def folder_of(store: MilvusStore) -> str:
    with store._database.reading() as connection:
        return ledger.objects_folder(connection)


def names_in(objects: Objects, store: MilvusStore) -> set[str]:
    """All objects."""
    folder = folder_of(store)
    return {name for page in objects.names_after(folder, folder) for name in page}


def image_of(name: str) -> bytes:
    return f"image of {name}".encode()


def test_a_map_with_objects_is_the_same_map(store: MilvusStore, servers: Servers, tmp_path: Path) -> None:
    here, back = Atlas(tmp_path / "here"), Atlas(tmp_path / "back")
    files = [tmp_path / f"{number}.tar" for number in range(3)]
    first = filled(here.create(ID, ENCODER, DIMENSION, MapSettings(), LOCAL_SHAPE))
    first.exporter.write(files[0])
    second = imported(store, files[0])
    second.exporter.write(files[1])
    imported(back, files[1]).exporter.write(files[2])
    assert files[0].read_bytes() == files[1].read_bytes() == files[2].read_bytes()
    places = second.places(None, 100)[0]
    assert {place.picture for place in places} >= {"image", "thumbnail"}
    for place in places:
        assert second.picture(place.id) == first.picture(place.id)
    assert store.verify(ID).ok
    room = second.storage_status()
    kept = sum(len(first.picture(place.id) or b"") for place in places)
    assert room.keypoints is not None and room.database == kept + room.keypoints.bytes
    here.close()
    back.close()


def test_old_pictures_stay_where_they_are(store: MilvusStore, lab: MilvusMap, servers: Servers) -> None:
    without = connected(servers, None)
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


def test_frames_for_review(store: MilvusStore, lab: MilvusMap, objects: Objects, servers: Servers) -> None:
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


def test_a_page_for_review_is_of_one_moment(store: MilvusStore, lab: MilvusMap) -> None:
    check_pages_are_of_one_moment(lab.review, store.get("lab").review)


def test_lost_and_damaged_objects_are_reported(store: MilvusStore, lab: MilvusMap, objects: Objects) -> None:
    lab.enrol([frame(name) for name in ("whole", "lost", "damaged")])
    objects.delete([where(lab, "lost").name])
    objects.put({where(lab, "damaged").name: b"image of daMaged"})
    report = store.verify("lab")
    assert not report.ok and [text.split("'")[1] for text in report.problems] == ["lost", "damaged"]
    for name in ("lost", "damaged"):
        with pytest.raises(StorageFailure, match=f"'{name}' is missing in the object store, or damaged"):
            lab.picture(name)
    assert lab.picture("whole") == image_of("whole")


def test_pictures_go_after_their_rows(store: MilvusStore, lab: MilvusMap, objects: Objects) -> None:
    """Those of deleted places and maps, and those of writes that died, but none that is being written or exported."""
    lab.enrol([frame("stays"), frame("goes")])
    other = store.create("other", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    other.enrol([frame("goes-too")])
    stays, goes, too = where(lab, "stays").name, where(lab, "goes").name, where(other, "goes-too").name
    with lab.viewing() as (connection, _):
        last = ledger.last_key(connection)
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
        patched.setattr("core.milvus.ledger.LEFT_SECONDS", 0)
        lab.forget("goes")
    assert goes in names_in(objects, store)
    store.sweep_objects()
    assert goes not in names_in(objects, store)
    objects.delete([later])


def test_what_is_being_written_stays(
    store: MilvusStore, lab: MilvusMap, objects: Objects, monkeypatch: pytest.MonkeyPatch
) -> None:
    update, written, go_on = ledger.update, threading.Event(), threading.Event()

    def slow(*args: object) -> None:
        written.set()
        assert go_on.wait(60)
        update(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(ledger, "update", slow)
    threads = [threading.Thread(target=work) for work in (lambda: lab.enrol([frame("a")]), store.sweep_objects)]
    threads[0].start()
    assert written.wait(60)
    threads[1].start()
    threads[1].join(0.3)  # whether it has come to the lock by then or not
    go_on.set()
    for thread in threads:
        thread.join(60)
    assert lab.picture("a") == image_of("a")


def refusing(servers: Servers) -> dict[str, tuple[Bucket, str]]:
    bucket = servers.bucket
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


def test_a_store_that_refuses(store: MilvusStore, lab: MilvusMap, servers: Servers) -> None:
    """Each refusal says why; nothing is changed, nothing stays behind, and queries are answered."""
    lab.enrol([frame("a")])
    for name, (bucket, why) in refusing(servers).items():
        other = connected(servers, bucket)
        there = other.get("lab")
        with pytest.raises(StoreUnavailable, match=why):
            other.check_pictures()
        time.sleep(0.6)  # when it is asked again
        with pytest.raises(StoreUnavailable, match=why):
            there.enrol([frame("b"), frame("c")])
        other.check_writable()
        ((rows, _),) = there.scope().search(descriptor_of("a")[np.newaxis])
        assert [place.id for place in there.places_at(rows.tolist()) if place] == ["a"], name
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


def test_a_full_store(store: MilvusStore, lab: MilvusMap, servers: Servers, tmp_path: Path) -> None:
    lab.enrol([frame("a")])
    command, bucket, answers = object_store(
        tmp_path, fixed_ports(PORTS), "-volume.max=1", "-master.volumeSizeLimitMB=1"
    )
    server = Server(command, tmp_path, answers)
    server.start()
    try:
        other = connected(servers, bucket)
        there = other.get("lab")
        large = np.random.default_rng(0).bytes(400_000)
        kept = []
        with pytest.raises((StorageFull, StoreUnavailable), match="takes no pictures: 500 Internal Server Error"):
            for number in range(10):
                there.enrol([replace(frame(f"b{number}"), image=large)])
                kept.append(f"b{number}")
        assert kept and [place.id for place in there.places(None, 100)[0]] == ["a", *kept]
        assert all(there.picture(name) == large for name in kept)
        with pytest.raises(StorageFailure, match="takes no pictures"):
            other.check_pictures()
        other.close()
    finally:
        server.end(signal.SIGKILL)  # it would take its time


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
