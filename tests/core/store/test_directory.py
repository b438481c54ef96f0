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
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame

REPOSITORY = Path(__file__).parents[3]


def names(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))


def test_the_directory_is_made_with_all_above_it(tmp_path: Path) -> None:
    directory = tmp_path / "a" / "b" / "data"
    atlas = Directory(directory)
    assert names(directory) == ["FORMAT", "LOCK", "maps"]
    assert atlas.records(None, 10) == ([], None)
    atlas.close()
    atlas.close()


def test_a_map_is_made_whole(atlas: Directory, directory: Path) -> None:
    settings = MapSettings(description="the lab", keep="none", same_place_radius=2.5, same_place_frames=0)
    lab = atlas.create("lab", ENCODER, DIMENSION, settings, local_shape=LOCAL_SHAPE)
    assert atlas.get("lab") is lab
    assert lab.record.settings() == settings
    assert (lab.record.id, lab.record.encoder, lab.record.dimension) == ("lab", ENCODER, DIMENSION)
    assert names(directory / "maps") == ["lab"]
    assert lab.verify().ok
    with pytest.raises(MapExists):
        atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)


def test_the_shape_of_the_local_descriptors_is_the_maps_for_life(directory: Path) -> None:
    atlas = Directory(directory)
    atlas.create("lab", ENCODER, DIMENSION, local_shape=(7, 2)).enrol([frame("p", local_shape=(7, 2))])
    atlas.create("hall", ENCODER, DIMENSION).enrol([frame("p", local_shape=(0, 0))])
    with pytest.raises(ValueError, match="cannot have"):
        atlas.create("none", ENCODER, DIMENSION, local_shape=(7, 0))
    atlas.close()
    atlas = Directory(directory)
    assert [atlas.get(name).record.local_shape for name in ("lab", "hall")] == [(7, 2), (0, 0)]
    assert [atlas.get(name).snapshot().local_shape for name in ("lab", "hall")] == [(7, 2), (0, 0)]
    for name in ("lab", "hall"):
        with pytest.raises(ValueError, match="local descriptors"):
            atlas.get(name).enrol([frame("q", local_shape=(2, 7))])
        assert atlas.get(name).verify().ok
    assert names(directory / "maps") == ["hall", "lab"]
    atlas.close()


@pytest.mark.parametrize("name", ["import", "Lab", "", "../lab", ".making-x", "a/b", "x" * 65])
def test_what_cannot_name_a_map(atlas: Directory, directory: Path, name: str) -> None:
    with pytest.raises(InvalidIdentifier):
        atlas.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    assert names(directory / "maps") == []
    for call in (atlas.get, atlas.delete, atlas.verify):
        with pytest.raises(UnknownMap):
            call(name)


def test_maps_are_listed_page_by_page(atlas: Directory) -> None:
    for name in ("b", "a", "d", "c"):
        atlas.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    first, cursor = atlas.records(None, 3)
    assert [record.id for record in first] == ["a", "b", "c"]
    second, last = atlas.records(cursor, 3)
    assert ([record.id for record in second], last) == (["d"], None)
    with pytest.raises(InvalidCursor):
        atlas.records("nonsense", 3)
    with pytest.raises(ValueError, match="at least one"):
        atlas.records(None, 0)


def test_a_deleted_map_is_gone_and_its_name_is_free(atlas: Directory, directory: Path) -> None:
    atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame("p")])
    atlas.delete("lab")
    assert names(directory / "maps") == []
    for call in (atlas.get, atlas.delete):
        with pytest.raises(UnknownMap):
            call("lab")
    again = atlas.create("lab", ENCODER, DIMENSION + 1, local_shape=LOCAL_SHAPE)
    again.enrol([frame("q", dimension=DIMENSION + 1)])
    assert (again.count_places(), again.verify().ok) == (1, True)


def test_maps_are_found_at_the_next_start_and_read_on_first_use(directory: Path) -> None:
    with_places = Directory(directory, rows_per_segment=4)
    for name in ("hall", "lab"):
        with_places.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol(
            [frame(f"{name}{i}") for i in range(6)]
        )
    with_places.close()
    atlas = Directory(directory, rows_per_segment=100)  # the maps there are keep theirs
    assert [record.id for record in atlas.records(None, 10)[0]] == ["hall", "lab"]
    assert all(found._opened is None for found in atlas._maps.values())
    assert (atlas.find("hall").record.id, atlas.find("hall").count_places()) == ("hall", 6)
    lab = atlas.get("lab")
    assert atlas._maps["hall"]._opened is None
    assert lab.count_places() == 6
    lab.enrol([frame(f"more{i}") for i in range(6)])
    assert [len(segment) for segment in lab.snapshot().segments] == [4, 4, 4]
    assert atlas.get("hall").verify().ok
    atlas.close()


def test_what_a_crash_left_half_done_is_cleared_away(directory: Path) -> None:
    atlas = Directory(directory)
    atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    atlas.close()
    maps = directory / "maps"
    shutil.copytree(maps / "lab", maps / ".making-hall-0123")
    shutil.copytree(maps / "lab", maps / ".removing-lab-4567")
    (maps / "lab" / "index-000001.faiss.tmp").write_bytes(b"half")
    (maps / "README").write_text("somebody's note")
    atlas = Directory(directory)
    assert names(maps) == ["README", "lab"]
    assert [record.id for record in atlas.records(None, 10)[0]] == ["lab"]
    atlas.get("lab").enrol([frame("p")])
    assert not list((maps / "lab").glob("*.tmp"))
    atlas.close()


def test_one_process_at_a_time(directory: Path) -> None:
    command = [sys.executable, "-m", "tests.core.storage.worker", "hold", str(directory)]
    with subprocess.Popen(command, cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdin is not None
        assert other.stdout is not None
        assert other.stdout.readline() == b"ack holding\n"
        with pytest.raises(DataDirectoryLocked, match="Another process"):
            Directory(directory)
        other.kill()  # even a process that is killed lets go
    Directory(directory).close()


def test_a_second_atlas_in_this_process_is_refused_too(atlas: Directory, directory: Path) -> None:
    with pytest.raises(DataDirectoryLocked):
        Directory(directory)


def test_a_closed_atlas_answers_no_more(directory: Path) -> None:
    atlas = Directory(directory)
    lab = atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    atlas.close()
    for call in (
        lambda: atlas.get("lab"),
        lambda: atlas.create("x", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE),
        atlas.check_writable,
    ):
        with pytest.raises(StorageFailure, match="closed"):
            call()
    with pytest.raises(StorageFailure, match="closed"):
        lab.enrol([frame("p")])
    assert names(directory / "maps" / "lab") == ["map.sqlite"]


def test_a_later_arrangement_or_schema_is_refused(directory: Path) -> None:
    Directory(directory).close()
    (directory / "FORMAT").write_text("placerec data 1\n")
    Directory(directory).close()
    assert (directory / "FORMAT").read_text() == "placerec data 2\n"
    (directory / "FORMAT").write_text("placerec data 3\n")
    with pytest.raises(DataDirectoryTooNew):
        Directory(directory)
    (directory / "FORMAT").write_text("something else")
    with pytest.raises(StorageFailure, match="right directory"):
        Directory(directory)
    (directory / "FORMAT").unlink()
    atlas = Directory(directory)
    atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    atlas.close()
    edit(directory, "PRAGMA user_version = 99")
    edit(directory, "ALTER TABLE places ADD COLUMN floor INTEGER")
    with pytest.raises(DataDirectoryTooNew, match="schema 99"):
        Directory(directory)
    edit(directory, "ALTER TABLE places DROP COLUMN floor")
    Directory(directory).close()  # and it let go of the lock each time


def test_a_map_of_an_older_schema_is_refused_by_name_and_not_touched(directory: Path) -> None:
    atlas = Directory(directory)
    for name in ("hall", "lab"):
        atlas.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    atlas.close()
    edit(directory, "ALTER TABLE maps DROP COLUMN collection")
    edit(directory, "PRAGMA user_version = 9")
    before = {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}
    with pytest.raises(DataDirectoryTooOld) as error:
        Directory(directory)
    assert str(error.value).startswith(f"{directory / 'maps' / 'lab' / 'map.sqlite'} was written before the first")
    assert "enrol again in a new data directory" in str(error.value)
    assert {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()} == before


def test_the_disk_can_be_written_or_not(atlas: Directory, directory: Path) -> None:
    before = names(directory)
    atlas.check_writable()
    assert names(directory) == before
    shutil.rmtree(directory)
    with pytest.raises(StorageFailure):
        atlas.check_writable()


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


def with_another_layout(folder: Path) -> None:
    edit(folder.parents[1], "UPDATE layout SET rows_per_segment = 5")


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
        with_another_layout,
        without_a_table,
        of_another_name,
        somebody_elses,
    ],
    ids=lambda spoil: spoil.__name__,
)
def test_a_map_whose_database_is_damaged_is_quarantined_and_the_others_serve(
    directory: Path, spoil: Callable[[Path], None]
) -> None:
    atlas = Directory(directory, rows_per_segment=4)
    for name in ("hall", "lab"):
        atlas.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame(f"{name}{i}") for i in range(6)])
    atlas.close()
    spoil(directory / "maps" / "lab")
    atlas = Directory(directory)
    try:
        with pytest.raises(MapQuarantined, match="damaged and out of service"):
            atlas.get("lab")
        assert list(atlas.quarantined()) == ["lab"]
        assert atlas.quarantined()["lab"]
        assert [record.id for record in atlas.records(None, 10)[0]] == ["hall"]
        assert atlas.get("hall").snapshot().search(descriptor_of("hall3"))[0][0] == 3
        with pytest.raises(MapExists):
            atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
        report = atlas.verify("lab")
        assert not report.ok
        assert report.problems[0] == f"out of service: {atlas.quarantined()['lab']}"
        atlas.delete("lab")
        assert atlas.quarantined() == {}
        assert atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).count_places() == 0
    finally:
        atlas.close()


def test_a_database_damaged_in_use_takes_its_map_out_of_service(atlas: Directory, lab: Map, directory: Path) -> None:
    lab.enrol([frame(f"p{i}", metadata={"text": "x" * 3000}) for i in range(200)])
    opened = lab._opened
    assert opened is not None
    opened.database.empty_log()
    with (directory / "maps" / "lab" / "map.sqlite").open("r+b") as file:
        file.seek(4096)
        file.write(os.urandom(400_000))
    with pytest.raises(MapQuarantined):
        for i in range(200):
            lab.place(f"p{i}")
    assert list(atlas.quarantined()) == ["lab"]
    for call in (lab.snapshot, lambda: lab.enrol([frame("q")]), lambda: atlas.get("lab")):
        with pytest.raises(MapQuarantined):
            call()
    assert not atlas.verify("lab").ok
    atlas.delete("lab")
    assert names(directory / "maps") == []
