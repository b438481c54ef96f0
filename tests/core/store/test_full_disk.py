"""A disk that is full, really: a small file system, and a limit on the size of files."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from hashlib import sha256
from itertools import count
from pathlib import Path

import pytest

from core.disk.reserve import Reserve
from core.errors import StorageFull
from core.ledger.maps import rows
from core.ledger.maps.connection import MapConnection
from core.maps import Enrolment, MapSettings, PlaceFilter
from core.store import Directory, Map
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame
from tests.core.store.worker import LARGE

REPOSITORY = Path(__file__).parents[3]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 16 MB."""
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(folder)], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip("a small file system cannot be mounted here (it takes root)")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill_up(folder: Path, left: int) -> Path:
    """A file that leaves so many bytes free."""
    ballast = folder / "ballast"
    free = os.statvfs(folder)
    with ballast.open("wb") as file:
        file.write(b"\x00" * max(0, free.f_bavail * free.f_frsize - left))
    return ballast


def large_frame(place_id: str, dimension: int, image_bytes: int) -> Enrolment:
    image = os.urandom(image_bytes)
    return replace(frame(place_id, dimension=dimension), image=image, digest=sha256(image).digest())


def until_refused(lab: Map, dimension: int, image_bytes: int, batch: int) -> list[str]:
    """Enrols until the disk is full; returns the ids that were taken."""
    taken: list[str] = []
    for i in count():
        names = [f"p{i}-{j}" for j in range(batch)]
        try:
            lab.enrol([large_frame(name, dimension, image_bytes) for name in names])
        except StorageFull:
            return taken
        taken += names
    raise AssertionError


@pytest.mark.thorough
@pytest.mark.parametrize("left", [700_000, 1_400_000])
@pytest.mark.parametrize(
    ("dimension", "image_bytes", "batch"),
    [(4096, 10, 1), (4096, 10, 7), (16, 50_000, 1), (16, 9_000, 5), (1024, 4_000, 3)],
    ids=["descriptors", "descriptor-batches", "pictures", "picture-batches", "both"],
)
def test_nothing_is_half_written_and_the_map_goes_on(
    small_disk: Path, dimension: int, image_bytes: int, batch: int, left: int
) -> None:
    directory = small_disk / "data"
    atlas = Directory(directory, rows_per_segment=8)
    lab = atlas.create("lab", ENCODER, dimension, MapSettings(keep="image"), local_shape=LOCAL_SHAPE)
    lab.enrol([large_frame("first", dimension, image_bytes)])
    ballast = fill_up(small_disk, left)

    taken = until_refused(lab, dimension, image_bytes, batch)
    assert taken
    before = lab.snapshot()
    for _ in range(3):  # and again, and nothing grows
        with pytest.raises(StorageFull):
            lab.enrol([large_frame(f"q{j}", dimension, 400_000) for j in range(3)])
    assert lab.snapshot() is before
    ids = ["first", *taken]
    assert [place.id for place in lab.places(None, 1000)[0]] == ids
    best, _ = before.search(descriptor_of(ids[-1], dimension))
    (found,) = lab.places_at(best[:1].tolist())
    assert found is not None
    assert found.id == ids[-1]
    assert lab.verify().ok

    ballast.unlink()
    lab.enrol([large_frame("after", dimension, image_bytes)])
    assert lab.verify().ok
    atlas.close()
    atlas = Directory(directory)
    lab = atlas.get("lab")
    assert [place.id for place in lab.places(None, 1000)[0]] == [*ids, "after"]
    report = lab.verify()
    assert (report.ok, report.stale_caches) == (True, [])
    atlas.close()


def test_deleting_a_sequence_makes_room(small_disk: Path) -> None:
    atlas = Directory(small_disk / "data", rows_per_segment=8)
    lab = atlas.create("lab", ENCODER, LARGE, MapSettings(keep="none"), local_shape=LOCAL_SHAPE)
    for name in ("monday", "tuesday"):
        lab.enrol([frame(f"{name}{i}", dimension=LARGE, sequence=name) for i in range(48)])
    atlas.close()
    atlas = Directory(small_disk / "data", rows_per_segment=8)
    lab = atlas.get("lab")
    more = [frame(f"new{i}", dimension=LARGE) for i in range(40)]
    reserve = Reserve(small_disk, 2_000_000)  # a deletion needs a little, too
    assert reserve.hold()
    fill_up(small_disk, 300_000)
    with pytest.raises(StorageFull):
        for start in range(0, 40, 8):
            lab.enrol(more[start : start + 8])
    there = lab.count_places()
    assert reserve.making_room(lambda: lab.forget_sequence("monday")) == 48
    assert lab.verify().ok and lab.count_places() == there - 48
    assert lab._left()[0] == 0
    lab.enrol(more[32:])
    assert lab.count_places() == there - 40 and lab.verify().ok
    atlas.close()


def test_a_write_stays_acknowledged_when_what_is_deleted_behind_it_finds_no_room(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A write deletes rows that died a while ago in a transaction of its own, which may fail."""
    atlas = Directory(small_disk / "data", rows_per_segment=8)
    lab = atlas.create("lab", ENCODER, LARGE, MapSettings(keep="image"), local_shape=LOCAL_SHAPE)
    lab.enrol([large_frame(f"p{i}", LARGE, 30_000) for i in range(12)])
    searched = lab.snapshot()
    assert lab.forget_all(PlaceFilter(ids=tuple(f"p{i}" for i in range(8))), 100)
    assert lab._left()[0] == 8 and len(searched) == 12
    monkeypatch.setattr(rows, "LEFT_SECONDS", 0)
    clear = rows.clear

    def without_room(connection: MapConnection, at_once: bool) -> int:
        fill_up(small_disk, 0)
        return clear(connection, at_once)

    monkeypatch.setattr(rows, "clear", without_room)
    lab.edit({"description": "acknowledged"})
    assert "The disk is full" in caplog.text
    for _ in range(2):
        assert lab.record.description == "acknowledged" and lab.verify().ok and lab.count_places() == 4
        atlas.close()
        (small_disk / "ballast").unlink(missing_ok=True)
        atlas = Directory(small_disk / "data")
        lab = atlas.get("lab")
    monkeypatch.undo()
    monkeypatch.setattr(rows, "LEFT_SECONDS", 0)
    lab.edit({"description": "again"})
    assert lab._left()[0] == 0 and lab.verify().ok
    atlas.close()


def test_a_map_that_finds_no_room_is_not_made(small_disk: Path) -> None:
    atlas = Directory(small_disk / "data")
    atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame("p")])
    ballast = fill_up(small_disk, 0)
    with pytest.raises(StorageFull):
        atlas.create("hall", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    with pytest.raises(StorageFull):
        atlas.check_writable()
    assert os.listdir(small_disk / "data" / "maps") == ["lab"]
    assert [record.id for record in atlas.records(None, 10)[0]] == ["lab"]
    assert atlas.get("lab").place("p").id == "p"
    atlas.delete("lab")  # making room is always possible
    ballast.unlink()
    atlas.check_writable()
    atlas.create("hall", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    atlas.close()


def test_a_start_on_a_full_disk_is_made_up_for_when_there_is_room(small_disk: Path) -> None:
    atlas = Directory(small_disk / "data")
    atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame("p")])
    atlas.close()
    ballast = fill_up(small_disk, 0)
    atlas = Directory(small_disk / "data")
    assert list(atlas.quarantined()) == ["lab"]
    with pytest.raises(StorageFull):
        atlas.get("lab")
    ballast.unlink()
    assert atlas.get("lab").place("p").id == "p"
    assert atlas.quarantined() == {}
    atlas.close()


@pytest.mark.thorough
def test_a_file_that_may_not_grow_has_what_was_acknowledged(directory: Path) -> None:
    """By the limit that a process can set on itself, so that it runs everywhere."""
    command = [sys.executable, "-m", "tests.core.store.worker", "fill", str(directory)]
    finished = subprocess.run(command, cwd=REPOSITORY, capture_output=True, check=True, timeout=300)
    answer = json.loads(finished.stdout)
    assert answer["error"] in ("StorageFull", "StorageFailure")  # SQLite does not say why the system refused
    assert answer["places"] > 20
    assert (answer["after"], answer["ok"]) == (answer["places"] + 1, True)
