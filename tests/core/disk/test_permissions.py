"""Files and folders that are for one user alone, whatever the process's umask is."""

from __future__ import annotations

import logging
import os
import sqlite3
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from core.disk.files import FolderLock, make_folder, replacing, write_file
from core.disk.permissions import close_to_others, make_private
from core.disk.sqlite_file import connect


@pytest.fixture(autouse=True)
def open_umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


def test_whatever_is_made_is_private(tmp_path: Path) -> None:
    folder = tmp_path / "of" / "maps"
    make_folder(folder)
    (folder / "stale.tmp").write_text("of another version")
    write_file(folder / "stale", b"x")
    with replacing(folder / "made") as temporary, temporary.open("wb") as file:
        assert mode(temporary) == 0o600
        file.write(b"x")
    FolderLock(folder / "LOCK").release()
    connection = connect(folder / "file.sqlite", "rwc")
    connection.execute("CREATE TABLE t (a)")
    assert {path.name: mode(path) for path in folder.iterdir()} == dict.fromkeys(
        ("stale", "made", "LOCK", "file.sqlite", "file.sqlite-wal", "file.sqlite-shm"), 0o600
    )
    connection.close()
    assert mode(folder) == mode(folder.parent) == 0o700
    write_file(folder / "report", b"x", private=False)
    assert mode(folder / "report") == 0o666


def test_an_open_database_keeps_its_locks(tmp_path: Path) -> None:
    """A second connection that would make the file does not open and close it beside the first."""
    path = tmp_path / "file.sqlite"
    first = connect(path, "rwc", {"journal_mode": "DELETE"})
    first.execute("CREATE TABLE t (a)")
    first.execute("BEGIN EXCLUSIVE")
    make_private(path)
    child = os.fork()
    if child == 0:
        try:
            sqlite3.connect(path, timeout=0).execute("INSERT INTO t VALUES (1)")
        except sqlite3.OperationalError:
            os._exit(7)  # it is locked
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    first.close()


def test_a_folder_of_before_is_closed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder, outside = tmp_path / "data", tmp_path / "outside"
    (folder / "maps" / "lab").mkdir(0o777, parents=True)
    outside.write_text("of somebody else")
    for name in ("maps/lab/map.sqlite", "maps/lab/keys.sqlite", "keys.sqlite", "LOCK"):
        (folder / name).write_text("x")
    (folder / "LOCK").chmod(0o755)
    (folder / "link").symlink_to(outside)
    os.mkfifo(folder / "pipe", 0o666)
    with caplog.at_level(logging.WARNING):
        close_to_others(folder, frozenset({"keys.sqlite"}))
    modes = {str(path.relative_to(folder)): mode(path) for path in folder.rglob("*") if not path.is_symlink()}
    assert modes == {
        "maps": 0o700,
        "maps/lab": 0o700,
        "maps/lab/map.sqlite": 0o600,
        "maps/lab/keys.sqlite": 0o600,
        "keys.sqlite": 0o666,  # its reader refuses it
        "LOCK": 0o700,
        "pipe": 0o666,
    }
    assert mode(folder) == 0o700 and mode(outside) == 0o666
    assert [line.args[1] for line in caplog.records if isinstance(line.args, tuple)] == [6]
    caplog.clear()
    (folder / "later").write_text("x")
    close_to_others(folder)
    assert mode(folder / "later") == 0o666 and not caplog.records  # nobody else can enter the folder


@pytest.mark.skipif(os.geteuid() != 0, reason="gives a file to another user")
def test_what_belongs_to_another_user_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "data"
    folder.mkdir(0o755)
    (folder / "FORMAT").write_text("x")
    os.chown(folder, 12345, 12345)
    close_to_others(folder)
    assert mode(folder) == 0o755 and mode(folder / "FORMAT") == 0o600
    assert f"others can read {folder} and 0 more" in caplog.text
