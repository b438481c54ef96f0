"""The room that is held back, on a small file system and beside a disk that says that it is full."""

from __future__ import annotations

import os
import sqlite3
import subprocess
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from core.disk.reserve import FILE, Reserve, lend_from
from core.disk.sqlite_file import connect
from core.errors import StorageFull

SIZE = 256 << 10


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 2 MB."""
    folder = tmp_path / "small"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(folder)]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("a small file system cannot be mounted here (it takes root)")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(folder: Path) -> Path:
    """A file that leaves no byte free."""
    found = os.statvfs(folder)
    ballast = folder / "ballast"
    ballast.write_bytes(bytes(found.f_bavail * found.f_frsize))
    return ballast


def writing(folder: Path, size: int) -> None:
    """Needs room, as a database does that notes a deletion."""
    try:
        (folder / "log").write_bytes(bytes(size))
    except OSError as error:
        raise StorageFull(str(error)) from error


def test_a_full_disk_has_room_to_open_databases_with(small_disk: Path) -> None:
    """For reading, too, SQLite makes a file for the index of its log; without any room it is not opened."""
    paths = [small_disk / "maps" / name for name in ("one", "two")]
    paths[0].parent.mkdir()
    for path in paths:
        with closing(connect(path, "rwc")) as made:
            made.execute("CREATE TABLE places (id TEXT)")
            made.execute("INSERT INTO places VALUES ('p1')")
    Reserve(small_disk, SIZE).hold()
    fill(small_disk)
    with pytest.raises(sqlite3.OperationalError):
        connect(paths[0])
    lend_from(small_disk)
    opened = [connect(path) for path in paths]
    for one in opened:
        assert one.execute("SELECT id FROM places").fetchall() == [("p1",)]
    assert os.statvfs(small_disk).f_bavail == 0 and 0 < (small_disk / FILE).stat().st_size < SIZE, "it is held again"
    for one in opened:
        one.close()


def test_a_full_disk_has_room_to_delete_with(small_disk: Path) -> None:
    reserve = Reserve(small_disk, SIZE)
    assert reserve.hold() and (small_disk / FILE).stat().st_size == SIZE
    assert (small_disk / FILE).stat().st_mode & 0o777 == 0o600
    ballast = fill(small_disk)
    with pytest.raises(StorageFull):
        writing(small_disk, 1 << 16)
    reserve.making_room(lambda: writing(small_disk, 1 << 16))
    left = (small_disk / FILE).stat().st_size
    assert SIZE // 2 < left <= SIZE - (1 << 16), "what is left is held again"
    reserve.making_room(lambda: writing(small_disk, 1 << 17))
    with pytest.raises(StorageFull):
        reserve.making_room(lambda: writing(small_disk, 1 << 20))
    assert not reserve.hold()
    ballast.unlink()
    assert reserve.hold() and (small_disk / FILE).stat().st_size == SIZE


def test_nothing_is_held_where_there_is_little_room_or_none_is_wanted(small_disk: Path) -> None:
    assert not Reserve(small_disk, 1 << 20).hold() and not (small_disk / FILE).exists()
    assert Reserve(small_disk, SIZE).hold()
    assert not Reserve(small_disk, 0).hold() and not (small_disk / FILE).exists()
    with pytest.raises(StorageFull):
        Reserve(small_disk, SIZE).making_room(lambda: writing(small_disk, 4 << 20))


def test_other_errors_are_passed_on(tmp_path: Path) -> None:
    reserve = Reserve(tmp_path, SIZE)
    reserve.hold()

    def fail() -> None:
        raise ValueError("something else")

    with pytest.raises(ValueError, match="something else"):
        reserve.making_room(fail)
    assert (tmp_path / FILE).stat().st_size == SIZE
    assert reserve.making_room(lambda: 7) == 7
