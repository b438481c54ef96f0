"""The file of a map: whole, the same bytes for the same content, in no writer's way, and nothing if it fails."""

from __future__ import annotations

import errno
import os
import threading
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from core.errors import MapQuarantined, StorageFailure, StorageFull, UnknownMap
from core.ledger.maps import archiving, places
from core.ledger.maps.connection import MapConnection
from core.ledger.sqlite import SqliteConnection
from core.maps import MapSettings, ReviewSetting
from core.maps.archives import writing
from core.maps.forms import COMPRESSED, HALF
from core.places import Neighborhood
from core.store import Directory, Map
from tests.core.store.archives.files import exported, imported, parts_of
from tests.core.store.edits import edit
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame, stored_of


def listed(map_: Map) -> list[object]:
    return [map_.places(None, 100), map_.sequences(None, 100), map_.cameras.all(), map_.transfer.sequence_ends()]


def label(map_: Map, **shown: object) -> object:
    return map_.review.label(1, {"label": shown, "at": "2026-11-28T10:00:00+00:00", "by": "ann"})


def same_place(map_: Map, place_id: str) -> list[str]:
    """The ids of the places that are the same place, sorted."""
    (row,), snapshot = map_.rows_of([place_id]), map_.snapshot()
    assert row is not None
    near = np.flatnonzero(snapshot.whereabouts.near(row, Neighborhood(0.5, 1)) & snapshot.alive)
    return sorted(place.id for place in map_.places_at(near.tolist()) if place is not None)


@pytest.mark.parametrize("kind", ["of everything", "compressed", "without local descriptors"])
def test_what_comes_back_is_what_was_there(
    atlas: Directory, tmp_path: Path, kind: str, request: pytest.FixtureRequest
) -> None:
    if kind == "of everything":
        source = request.getfixturevalue("full")
    else:
        shape, precision = (LOCAL_SHAPE, COMPRESSED) if kind == "compressed" else ((0, 0), HALF)
        source = atlas.create("lab", ENCODER, DIMENSION, MapSettings(), shape, precision=precision)
        source.enrol([frame(f"p{i}", local_shape=shape) for i in range(6)])
        source.forget("p2")
    path = tmp_path / "lab.tar"
    path.write_bytes(exported(source, tmp_path / "kept"))
    other = Directory(tmp_path / "other")
    copy = imported(other, path, "lab")
    assert copy.record == source.record and listed(copy) == listed(source)
    for place in source.places(None, 100)[0]:
        ours, theirs = (map_.snapshot() for map_ in (source, copy))
        row, other_row = (np.array(map_.rows_of([place.id])) for map_ in (source, copy))
        np.testing.assert_array_equal(ours.descriptors_at(row), theirs.descriptors_at(other_row))
        np.testing.assert_array_equal(ours.locals_at(row), theirs.locals_at(other_row))
        assert copy.digest(place.id) == source.digest(place.id)
        assert copy.picture(place.id) == source.picture(place.id)
        (ours_of,), (theirs_of,) = source.keypoints_at(row.tolist()), copy.keypoints_at(other_row.tolist())
        assert (ours_of and ours_of.record()) == (theirs_of and theirs_of.record())
        assert (ours_of is None) == (place.id == "roof")
        assert same_place(copy, place.id) == same_place(source, place.id)
    if kind == "of everything":
        assert same_place(copy, "q1") == ["q1", "roof"] and same_place(copy, "q0") == ["p1", "p2", "p3", "q0"]
    assert copy.verify().ok
    # Written again it is the same file, to the last bit: nothing was lost, nothing added, no order changed.
    assert exported(copy, tmp_path / "again") == path.read_bytes()
    copy.enrol([frame("new", local_shape=copy.record.local_shape)])
    assert copy.verify().ok
    other.close()


def test_damaged_keypoints_are_not_exported(full: Map, tmp_path: Path) -> None:
    edit(full, "UPDATE keypoints SET record = zeroblob(length(record)) WHERE row = 0")
    with pytest.raises(StorageFailure, match="The stored keypoints of place 'p0' do not match their checksum"):
        full.exporter.write(tmp_path / "kept.tar")
    assert not (tmp_path / "kept.tar").exists()


def test_the_same_content_is_the_same_file(full: Map, tmp_path: Path) -> None:
    first, second = full.exporter.write(tmp_path / "first.tar"), full.exporter.write(tmp_path / "second.tar")
    content = first.path.read_bytes()
    assert content == second.path.read_bytes() and first.tag == second.tag
    assert first.size == len(content) and first.tag in content[:8192].decode("ascii", "ignore")
    with pytest.raises(StorageFailure):  # a file that is there is never written over
        full.exporter.write(first.path)
    assert first.path.read_bytes() == content


def test_rows_of_forgotten_places_are_left_behind(content: bytes) -> None:
    manifest, parts = parts_of(content)
    assert manifest["places"] == 9
    assert stored_of("gone").astype("<f2").tobytes() not in content
    assert len(parts["descriptors-000001.bin"]) == 9 * (2 * DIMENSION + 15)


def test_groups(full: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = exported(full, tmp_path / "whole")
    monkeypatch.setattr(writing, "PLACES_PER_GROUP", 4)
    grouped = exported(full, tmp_path / "grouped")
    manifest, parts = parts_of(grouped)
    assert [part["rows"] for part in manifest["parts"][2:]] == [4] * 8 + [1] * 4
    joined = b"".join(data for name, data in parts.items() if name.startswith("descriptors-"))
    assert joined == parts_of(whole)[1]["descriptors-000001.bin"]
    path = tmp_path / "grouped.tar"
    path.write_bytes(grouped)
    other = Directory(tmp_path / "other")
    assert exported(imported(other, path, "lab"), tmp_path / "again") == grouped
    other.close()


def test_enrolment_goes_on_while_it_is_read(full: Map, tmp_path: Path) -> None:
    """The other thread's write ends while the reading is held up in the middle."""
    going, done = threading.Event(), threading.Event()

    def enrol() -> None:
        going.wait(10)
        full.enrol([frame("meanwhile")])
        done.set()

    thread = threading.Thread(target=enrol)
    thread.start()

    def advance(_read: int) -> None:
        going.set()
        assert done.wait(10), "a write waits for an export"

    export = full.exporter.write(tmp_path / "kept.tar", advance)
    thread.join()
    assert export.manifest.places == 9 and len(full.snapshot()) == 10
    _, parts = parts_of(export.path.read_bytes())
    assert b"meanwhile" not in parts["places-000001.jsonl"]


def test_a_map_that_is_deleted_does_not_wait_for_its_export(
    full: Map, atlas: Directory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writing, "PLACES_PER_GROUP", 2)
    going = threading.Event()

    def delete() -> None:
        going.wait(10)
        atlas.delete("lab")

    thread = threading.Thread(target=delete)
    thread.start()

    def advance(_read: int) -> None:
        going.set()
        while full.is_open:
            threading.Event().wait(0.001)

    with pytest.raises(UnknownMap):
        full.exporter.write(tmp_path / "kept.tar", advance)
    thread.join(10)
    assert not thread.is_alive() and list(tmp_path.glob("*.tar")) == []


def test_the_state_changes_with_every_write(full: Map) -> None:
    seen = [full.exporter.state()]
    for write in (
        lambda: full.enrol([frame("z")]),
        lambda: full.forget("z"),
        lambda: full.cameras.put("rear", None),
        lambda: full.edit({"description": "other"}),
        lambda: full.review.keep(b"shown", {"verdict": "unknown"}, ReviewSetting()) and label(full, stranger=True),
        lambda: label(full, place="a"),
        lambda: full.review.label(1, None),
    ):
        write()
        seen.append(full.exporter.state())
    assert all(one != other for one, other in pairwise(seen))
    full.snapshot()
    full.review.keep(b"another", {"verdict": "unknown"}, ReviewSetting())
    assert full.exporter.state() == seen[-1], "a frame without a label is not exported"


def test_a_full_disk_leaves_nothing(full: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(archiving._Source, "pictures", refuse)
    with pytest.raises(StorageFull):
        full.exporter.write(tmp_path / "kept.tar")
    assert list(tmp_path.glob("*.tar")) == []
    assert full.verify().ok


def test_the_size_is_known_before_anything_is_written(full: Map, tmp_path: Path) -> None:
    told = []

    def expect(size: int) -> None:
        assert not (tmp_path / "kept.tar").exists()
        told.append(size)
        if len(told) > 1:
            raise StorageFull("no room")

    made = full.exporter.write(tmp_path / "kept.tar", expect=expect)
    assert told == [made.size] == [made.path.stat().st_size]
    made.path.unlink()
    with pytest.raises(StorageFull, match="no room"):
        full.exporter.write(tmp_path / "kept.tar", expect=expect)
    assert list(tmp_path.glob("*.tar")) == []


@pytest.mark.parametrize(
    ("statement", "problem"),
    [
        ("UPDATE descriptors SET bytes = zeroblob(36) WHERE row = 0", "row 0 of descriptors does not match"),
        ("DELETE FROM locals WHERE row = 0", "a place has no descriptors"),
        ("UPDATE places SET regions = 7 WHERE id = 'p0'", "'p0' of places does not match its checksum"),
    ],
)
def test_damage_is_found_and_not_exported(full: Map, tmp_path: Path, statement: str, problem: str) -> None:
    edit(full, statement)
    with pytest.raises(MapQuarantined, match=problem):
        full.exporter.write(tmp_path / "kept.tar")
    assert list(tmp_path.glob("*.tar")) == []


def test_a_map_that_is_not_open_can_be_exported(
    directory: Path, full: Map, atlas: Directory, tmp_path: Path
) -> None:
    state = full.exporter.state()
    atlas.close()
    again = Directory(directory)
    found = again.find("lab")
    assert found.exporter.state() == state and not found.is_open
    assert exported(found, tmp_path / "kept")
    again.close()


def test_the_first_error_is_reported(full: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SQLite ends some transactions by itself, when the disk fails."""

    def ended(connection: MapConnection) -> None:
        assert isinstance(connection.whole, SqliteConnection)
        connection.whole.driver.execute("ROLLBACK")
        raise RuntimeError("the first of it")

    monkeypatch.setattr(places, "unsound", ended)
    with pytest.raises(RuntimeError, match="the first of it"):
        full.exporter.write(tmp_path / "kept.tar")


def test_no_file_is_written_that_could_not_be_read(full: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writing, "MOST_MANIFEST_BYTES", 500)
    with pytest.raises(StorageFailure, match="too many places for one file: 6 parts"):
        full.exporter.write(tmp_path / "kept.tar")
    assert list(tmp_path.glob("*.tar")) == []
