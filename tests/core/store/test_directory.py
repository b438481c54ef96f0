from __future__ import annotations

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from core.errors import (
    DataDirectoryLocked,
    DataDirectoryTooNew,
    DataDirectoryTooOld,
    InvalidCursor,
    InvalidIdentifier,
    MapExists,
    MapQuarantined,
    StorageFailure,
    UnknownMap,
)
from core.ledger.maps.checksums import checksum_of
from core.maps import MapSettings
from core.store import Directory, Map
from tests.core.store.conftest import OpenStore, file_of
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame

REPOSITORY = Path(__file__).parents[3]


def names(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))


def test_the_directory_is_made_with_all_above_it(tmp_path: Path) -> None:
    directory = tmp_path / "a" / "b" / "data"
    store = Directory(directory)
    assert names(directory) == ["FORMAT", "LOCK", "maps"]
    assert store.records(None, 10) == ([], None)
    store.close()
    store.close()


def test_a_map_is_made_whole(store: Directory, directory: Path) -> None:
    settings = MapSettings(description="the lab", keep="none", same_place_radius=2.5, same_place_frames=0)
    lab = store.create("lab", ENCODER, DIMENSION, settings, local_shape=LOCAL_SHAPE)
    assert store.get("lab") is lab
    assert lab.record.settings() == settings
    assert (lab.record.id, lab.record.encoder, lab.record.dimension) == ("lab", ENCODER, DIMENSION)
    assert names(directory / "maps") == ["lab"]
    assert lab.verify().ok
    with pytest.raises(MapExists):
        store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)


def test_the_shape_of_the_local_descriptors_is_the_maps_for_life(directory: Path) -> None:
    store = Directory(directory)
    store.create("lab", ENCODER, DIMENSION, local_shape=(7, 2)).enrol([frame("p", local_shape=(7, 2))])
    store.create("hall", ENCODER, DIMENSION).enrol([frame("p", local_shape=(0, 0))])
    with pytest.raises(ValueError, match="cannot have"):
        store.create("none", ENCODER, DIMENSION, local_shape=(7, 0))
    store.close()
    store = Directory(directory)
    assert [store.get(name).record.local_shape for name in ("lab", "hall")] == [(7, 2), (0, 0)]
    assert [store.get(name).snapshot().local_shape for name in ("lab", "hall")] == [(7, 2), (0, 0)]
    for name in ("lab", "hall"):
        with pytest.raises(ValueError, match="local descriptors"):
            store.get(name).enrol([frame("q", local_shape=(2, 7))])
        assert store.get(name).verify().ok
    assert names(directory / "maps") == ["hall", "lab"]
    store.close()


@pytest.mark.parametrize("name", ["import", "Lab", "", "../lab", ".making-x", "a/b", "x" * 65])
def test_what_cannot_name_a_map(store: Directory, directory: Path, name: str) -> None:
    with pytest.raises(InvalidIdentifier):
        store.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    assert names(directory / "maps") == []
    for call in (store.get, store.delete, store.verify):
        with pytest.raises(UnknownMap):
            call(name)


def test_maps_are_listed_page_by_page(store: Directory) -> None:
    for name in ("b", "a", "d", "c"):
        store.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    first, cursor = store.records(None, 3)
    assert [record.id for record in first] == ["a", "b", "c"]
    second, last = store.records(cursor, 3)
    assert ([record.id for record in second], last) == (["d"], None)
    with pytest.raises(InvalidCursor):
        store.records("nonsense", 3)
    with pytest.raises(ValueError, match="at least one"):
        store.records(None, 0)


def test_a_deleted_map_is_gone_and_its_name_is_free(store: Directory, directory: Path) -> None:
    store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame("p")])
    store.delete("lab")
    assert names(directory / "maps") == []
    for call in (store.get, store.delete):
        with pytest.raises(UnknownMap):
            call("lab")
    again = store.create("lab", ENCODER, DIMENSION + 1, local_shape=LOCAL_SHAPE)
    again.enrol([frame("q", dimension=DIMENSION + 1)])
    assert (again.count_places(), again.verify().ok) == (1, True)


def test_maps_are_found_at_the_next_start_and_read_on_first_use(open_store: OpenStore, store: Directory) -> None:
    for name in ("hall", "lab"):
        store.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame(f"{name}{i}") for i in range(6)])
    store.close()
    again = open_store()
    assert [record.id for record in again.records(None, 10)[0]] == ["hall", "lab"]
    assert again.open_maps == 0
    hall = again.find("hall")
    assert (hall.record.id, hall.count_places(), hall.is_open) == ("hall", 6, False)
    lab = again.get("lab")
    assert lab.is_open and again.opened("lab") is lab and again.opened("hall") is None and again.open_maps == 1
    lab.enrol([frame(f"more{i}") for i in range(6)])
    assert [len(segment) for segment in lab.snapshot().segments] == [4, 4, 4]
    assert again.get("hall").verify().ok


def test_what_a_crash_left_half_done_is_cleared_away(directory: Path) -> None:
    store = Directory(directory)
    store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    store.close()
    maps = directory / "maps"
    shutil.copytree(maps / "lab", maps / ".making-hall-0123")
    shutil.copytree(maps / "lab", maps / ".removing-lab-4567")
    (maps / "README").write_text("somebody's note")
    store = Directory(directory)
    assert names(maps) == ["README", "lab"]
    assert [record.id for record in store.records(None, 10)[0]] == ["lab"]
    store.get("lab").enrol([frame("p")])
    store.close()


def test_one_process_at_a_time(directory: Path) -> None:
    command = [sys.executable, "-m", "tests.core.store.worker", "hold", str(directory)]
    with subprocess.Popen(command, cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdin is not None
        assert other.stdout is not None
        assert other.stdout.readline() == b"ack holding\n"
        with pytest.raises(DataDirectoryLocked, match="Another process"):
            Directory(directory)
        other.kill()  # even a process that is killed lets go
    Directory(directory).close()


def test_a_second_one_in_this_process_is_refused_too(store: Directory, directory: Path) -> None:
    with pytest.raises(DataDirectoryLocked):
        Directory(directory)


def test_a_closed_one_answers_no_more(directory: Path) -> None:
    store = Directory(directory)
    lab = store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    store.close()
    for call in (
        lambda: store.get("lab"),
        lambda: store.create("x", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE),
        store.check_writable,
    ):
        with pytest.raises(StorageFailure, match="closed"):
            call()
    with pytest.raises(StorageFailure, match="closed"):
        lab.enrol([frame("p")])
    assert names(directory / "maps" / "lab") == ["map.sqlite"]


@pytest.mark.parametrize("earlier", ["placerec data 1\n", "placerec data 2\n"])
def test_a_directory_of_an_earlier_version_is_refused_and_not_touched(directory: Path, earlier: str) -> None:
    (directory / "maps" / "lab").mkdir(parents=True)
    (directory / "FORMAT").write_text(earlier)
    (directory / "maps" / "lab" / "descriptors-000001.seg").write_bytes(b"as it was")
    with pytest.raises(DataDirectoryTooOld) as error:
        Directory(directory)
    assert str(error.value) == (
        f"{directory} was written by placerec 1: export its maps with that version, and import the files into a new"
        " data directory."
    )
    left = {path.name: path.read_bytes() for path in directory.rglob("*") if path.is_file()}
    assert left == {"FORMAT": earlier.encode(), "LOCK": b"", "descriptors-000001.seg": b"as it was"}


def test_a_later_arrangement_or_schema_is_refused(directory: Path) -> None:
    Directory(directory).close()
    assert (directory / "FORMAT").read_text() == "placerec data 3\n"
    (directory / "FORMAT").write_text("placerec data 4\n")
    with pytest.raises(DataDirectoryTooNew):
        Directory(directory)
    (directory / "FORMAT").write_text("something else")
    with pytest.raises(StorageFailure, match="right directory"):
        Directory(directory)
    (directory / "FORMAT").unlink()
    store = Directory(directory)
    store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    store.close()
    edit(directory, "PRAGMA user_version = 99")
    edit(directory, "ALTER TABLE places ADD COLUMN floor INTEGER")
    with pytest.raises(DataDirectoryTooNew, match="schema 99"):
        Directory(directory)
    edit(directory, "ALTER TABLE places DROP COLUMN floor")
    Directory(directory).close()  # and it let go of the lock each time


def test_a_map_of_an_older_schema_is_refused_by_name_and_not_touched(directory: Path) -> None:
    store = Directory(directory)
    for name in ("hall", "lab"):
        store.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    store.close()
    edit(directory, "ALTER TABLE maps DROP COLUMN recall")
    edit(directory, "PRAGMA user_version = 13")
    before = {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}
    with pytest.raises(DataDirectoryTooOld) as error:
        Directory(directory)
    assert str(error.value).startswith(f"{directory / 'maps' / 'lab' / 'map.sqlite'} was written before the first")
    assert {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()} == before


def test_the_disk_can_be_written_or_not(store: Directory, directory: Path) -> None:
    before = names(directory)
    store.check_writable()
    assert names(directory) == before
    shutil.rmtree(directory)
    with pytest.raises(StorageFailure):
        store.check_writable()


def edit(directory: Path, *statements: str) -> None:
    connection = sqlite3.connect(directory / "maps" / "lab" / "map.sqlite", isolation_level=None)
    for statement in statements:
        connection.execute(statement)
    connection.close()


def garbage(folder: Path) -> None:
    (folder / "map.sqlite").write_bytes(os.urandom(20_000))


def empty(folder: Path) -> None:
    (folder / "map.sqlite").write_bytes(b"")


def missing(folder: Path) -> None:
    (folder / "map.sqlite").unlink()


def cut(folder: Path) -> None:
    os.truncate(folder / "map.sqlite", 5000)


def without_a_record(folder: Path) -> None:
    edit(folder.parents[1], "DELETE FROM maps")


def with_a_changed_record(folder: Path) -> None:
    edit(folder.parents[1], "UPDATE maps SET record = replace(record, 'thumbnail', 'image')")


def with_a_changed_name(folder: Path) -> None:
    edit(folder.parents[1], "UPDATE maps SET id = 'kitchen'")


def written_anew(folder: Path, **changes: object) -> None:
    """Change the record of a map, and its checksum with it."""
    connection = sqlite3.connect(folder / "map.sqlite", isolation_level=None)
    ((text,),) = connection.execute("SELECT record FROM maps").fetchall()
    changed = json.dumps({**json.loads(text), **changes})
    values = changed, checksum_of([changed]), json.loads(changed)["id"]
    connection.execute("UPDATE maps SET record = ?, seal = ?, id = ?", values)
    connection.close()


def with_a_senseless_record(folder: Path) -> None:
    written_anew(folder, keep="everything")


def without_a_table(folder: Path) -> None:
    edit(folder.parents[1], "DROP TABLE pictures")


def of_another_name(folder: Path) -> None:
    written_anew(folder, id="kitchen")


def somebody_elses(folder: Path) -> None:
    edit(folder.parents[1], "PRAGMA application_id = 1")


@pytest.mark.parametrize(
    "spoil",
    [
        garbage,
        empty,
        missing,
        cut,
        without_a_record,
        with_a_changed_record,
        with_a_changed_name,
        with_a_senseless_record,
        without_a_table,
        of_another_name,
        somebody_elses,
    ],
    ids=lambda spoil: spoil.__name__,
)
def test_a_map_whose_database_is_damaged_is_quarantined_and_the_others_serve(
    directory: Path, spoil: Callable[[Path], None]
) -> None:
    store = Directory(directory, rows_per_segment=4)
    for name in ("hall", "lab"):
        store.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame(f"{name}{i}") for i in range(6)])
    store.close()
    spoil(directory / "maps" / "lab")
    store = Directory(directory)
    try:
        with pytest.raises(MapQuarantined, match="damaged and out of service"):
            store.get("lab")
        assert list(store.quarantined()) == ["lab"]
        assert store.quarantined()["lab"]
        assert [record.id for record in store.records(None, 10)[0]] == ["hall"]
        assert store.get("hall").snapshot().search(descriptor_of("hall3"))[0][0] == 3
        with pytest.raises(MapExists):
            store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
        report = store.verify("lab")
        assert not report.ok
        assert report.problems[0] == f"out of service: {store.quarantined()['lab']}"
        store.delete("lab")
        assert store.quarantined() == {}
        assert store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).count_places() == 0
    finally:
        store.close()


def test_a_database_damaged_in_use_takes_its_map_out_of_service(store: Directory, lab: Map, directory: Path) -> None:
    lab.enrol([frame(f"p{i}", metadata={"text": "x" * 3000}) for i in range(200)])
    file_of(lab).rest()
    with (directory / "maps" / "lab" / "map.sqlite").open("r+b") as file:
        file.seek(8 * 8192)
        file.write(os.urandom(600_000))
    with pytest.raises(MapQuarantined):
        for i in range(200):
            lab.place(f"p{i}")
    assert list(store.quarantined()) == ["lab"] and store.opened("lab") is None
    for call in (lab.snapshot, lambda: lab.enrol([frame("q")]), lambda: store.get("lab")):
        with pytest.raises(MapQuarantined):
            call()
    assert not store.verify("lab").ok
    store.delete("lab")
    assert names(directory / "maps") == []
