from __future__ import annotations

import errno
import fcntl
import os
import resource
import sqlite3
import stat
from pathlib import Path

import pytest

from core.disk.files import TEMPORARY, Damage, FolderLock, disk_errors, write_at, write_file
from core.disk.sqlite_file import connect
from core.errors import DataDirectoryLocked, StorageFailure, StorageFull, TooManyOpenFiles, UnknownPlace


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_a_full_disk_has_its_own_error(code: int) -> None:
    with pytest.raises(StorageFull, match="could not enrol"), disk_errors("enrol"):
        raise OSError(code, os.strerror(code))


@pytest.mark.parametrize("code", [errno.EIO, errno.EROFS, errno.EACCES])
def test_other_refusals_are_failures(code: int) -> None:
    with pytest.raises(StorageFailure, match=os.strerror(code)), disk_errors("enrol"):
        raise OSError(code, os.strerror(code))


def test_that_no_descriptor_is_left_is_no_fault_of_the_disk(tmp_path: Path) -> None:
    path = tmp_path / "db"
    connect(path, "rwc").close()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    next_one = os.open(os.devnull, os.O_RDONLY)
    os.close(next_one)
    resource.setrlimit(resource.RLIMIT_NOFILE, (next_one, hard))
    try:
        with pytest.raises(TooManyOpenFiles, match="could not enrol"), disk_errors("enrol"):
            path.read_bytes()
        with pytest.raises(TooManyOpenFiles, match="could not enrol"), disk_errors("enrol"):
            connect(path)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    with pytest.raises(StorageFailure, match="unable to open") as raised, disk_errors("enrol"):
        connect(tmp_path / "missing")
    assert not isinstance(raised.value, TooManyOpenFiles)


def test_a_full_database_is_a_full_disk() -> None:
    connection = sqlite3.connect(":memory:", isolation_level=None)
    connection.execute("PRAGMA max_page_count = 3")
    connection.execute("CREATE TABLE t (b BLOB)")
    with pytest.raises(StorageFull), disk_errors("enrol"):
        connection.execute("INSERT INTO t VALUES (zeroblob(100000))")
    connection.close()


def test_a_file_that_is_no_database_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "garbage"
    path.write_bytes(os.urandom(8192))
    connection = sqlite3.connect(path)
    with pytest.raises(Damage), disk_errors("open"):
        connection.execute("SELECT * FROM sqlite_schema")
    connection.close()


def test_our_own_mistakes_and_errors_pass() -> None:
    with pytest.raises(UnknownPlace), disk_errors("enrol"):
        raise UnknownPlace("no")
    connection = sqlite3.connect(":memory:")
    connection.close()
    with pytest.raises(sqlite3.ProgrammingError), disk_errors("enrol"):
        connection.execute("SELECT 1")


def test_a_file_is_written_whole_and_leaves_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "f"
    write_file(path, b"one")
    write_file(path, b"two, longer")
    assert path.read_bytes() == b"two, longer"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_cannot_be_written_is_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.mkdir()  # a rename onto it is refused
    with pytest.raises(OSError):
        write_file(path, b"x")
    assert not path.with_name("f" + TEMPORARY).exists()


def test_writing_goes_on_after_a_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = os.pwrite
    monkeypatch.setattr(os, "pwrite", lambda descriptor, data, offset: whole(descriptor, data[:3], offset))
    with (tmp_path / "f").open("wb") as file:
        write_at(file.fileno(), b"abcdefgh", 2)
    assert (tmp_path / "f").read_bytes() == b"\x00\x00abcdefgh"


def test_one_holder_at_a_time(tmp_path: Path) -> None:
    lock = FolderLock(tmp_path / "LOCK")
    with pytest.raises(DataDirectoryLocked):
        FolderLock(tmp_path / "LOCK")
    lock.release()
    lock.release()
    FolderLock(tmp_path / "LOCK").release()


@pytest.mark.parametrize("replaced", [False, True])
def test_a_lock_holds_though_its_file_is_deleted(tmp_path: Path, replaced: bool) -> None:
    path = tmp_path / "LOCK"
    lock = FolderLock(path)
    path.unlink()
    if replaced:
        path.touch()
    with pytest.raises(DataDirectoryLocked):
        FolderLock(path)
    lock.release()
    FolderLock(path).release()


def test_the_file_alone_is_locked_where_folders_are_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on network file systems, which lock only what is open for writing."""
    whole = fcntl.flock

    def flock(descriptor: int, operation: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        whole(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    lock = FolderLock(tmp_path / "LOCK")
    with pytest.raises(DataDirectoryLocked):
        FolderLock(tmp_path / "LOCK")
    lock.release()
    FolderLock(tmp_path / "LOCK").release()
