"""The file system as durability needs it: files and folders synced, refusals told apart, one owner.

A file is durable when it was synced *and* the folder in which its name was made was synced.
"""

from __future__ import annotations

import errno
import fcntl
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from core.errors import DataDirectoryLocked, PlacerecError, StorageFailure, StorageFull

DISK_IS_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""No space, no quota, or past the largest file that this process may write: more room mends each."""

_SQLITE_IS_FULL = frozenset({sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_SHMSIZE})
_SQLITE_IS_DAMAGED = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_FORMAT})

TEMPORARY = ".tmp"
"""Suffix of a file that was not finished; such files are removed when a map is opened."""


class Damage(Exception):
    """What the disk holds of a map is not what was written there; the text says where."""


def missing(path: Path, error: FileNotFoundError) -> Damage:
    """What it is that a file of a map is missing: damage, unless all of its folder is out of reach.

    Raises:
        FileNotFoundError: the folder is missing, too: a disk that was taken away may be put back.
    """
    if not path.parent.is_dir():
        raise error
    return Damage(f"{path.name}: the file is missing")


def sync_folder(folder: Path) -> None:
    """Make the names within ``folder`` durable."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, as far as they are missing, and sync every name made."""
    if not folder.is_dir():
        make_folder(folder.absolute().parent)
        folder.mkdir(exist_ok=True)
        sync_folder(folder.absolute().parent)


def sync_file(path: Path) -> None:
    """Make the contents of ``path`` durable."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_at(descriptor: int, data: bytes | memoryview, offset: int) -> None:
    """Write all of ``data``; a disk that takes only a part of it raises at the rest."""
    remaining = memoryview(data)
    while remaining:
        written = os.pwrite(descriptor, remaining, offset)
        remaining, offset = remaining[written:], offset + written


def write_file(path: Path, data: bytes) -> None:
    """Put ``data`` at ``path`` whole or not at all, durably: temporary name, sync, rename, sync of the folder."""
    temporary = path.with_name(path.name + TEMPORARY)
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        try:
            write_at(descriptor, data, 0)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    sync_folder(path.parent)


def primary_code(error: sqlite3.Error) -> int | None:
    """SQLite's result code without its extension; None for errors that Python's module makes itself."""
    code: int | None = getattr(error, "sqlite_errorcode", None)
    return None if code is None else code & 0xFF


def _refusal(error: OSError | sqlite3.Error, action: str) -> Exception:
    if isinstance(error, OSError):
        if error.errno in DISK_IS_FULL:
            return StorageFull(f"The disk is full ({error.strerror}): could not {action}. Make room and try again.")
        return StorageFailure(f"The disk refused to {action}: {error.strerror or error}.")
    if getattr(error, "sqlite_errorcode", None) in _SQLITE_IS_FULL:
        return StorageFull(f"The disk is full: could not {action}. Make room and try again.")
    if primary_code(error) in _SQLITE_IS_DAMAGED or str(error).startswith("Could not decode to UTF-8"):
        return Damage(f"map.sqlite cannot be read: {error}")
    return StorageFailure(f"The disk refused to {action}: {error}.")


@contextmanager
def refusals(action: str) -> Iterator[None]:
    """Turn what the system says into our errors; ``action`` is an infinitive for the message.

    Raises:
        StorageFull: no space left, no quota left, or the file may not grow.
        StorageFailure: any other refusal of the system or of SQLite.
        Damage: SQLite finds its file damaged.
    """
    try:
        yield
    except PlacerecError:
        raise
    except (sqlite3.IntegrityError, sqlite3.ProgrammingError, sqlite3.InterfaceError):
        raise  # our own mistake, not the disk's
    except UnicodeDecodeError as error:  # SQLite names what it finds damaged, in letters that are damaged, too
        raise Damage("map.sqlite cannot be read: its text is damaged") from error
    except (OSError, sqlite3.Error) as error:
        raise _refusal(error, action) from error


class FolderLock:
    """Exclusive possession of a folder by one process, by an advisory lock on a file in it."""

    def __init__(self, path: Path) -> None:
        """Take the lock without waiting.

        Raises:
            DataDirectoryLocked: another holder has it.
        """
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(self._descriptor)
            raise DataDirectoryLocked(f"Another process holds {path.parent}: stop it first, or use --url.") from error
        except OSError:
            os.close(self._descriptor)
            raise

    def release(self) -> None:
        """Give the lock back; more than once does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
