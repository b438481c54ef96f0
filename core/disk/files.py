"""Writing files durably, naming the errors of the disk, and locking a folder for one process.

A file is durable when it was synced *and* the folder in which its name was made was synced.
"""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from core.disk.permissions import PRIVATE_FILE, PRIVATE_FOLDER, open_private
from core.errors import DataDirectoryLocked, PlacerecError, StorageFailure, StorageFull, TooManyOpenFiles

DISK_IS_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""There is no space, no quota, or the file would exceed the process's limit on file sizes: making room helps."""

NO_DESCRIPTOR = frozenset({errno.EMFILE, errno.ENFILE})
"""The process, or the machine, has as many open files as it may have."""

_SQLITE_IS_FULL = frozenset({sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_SHMSIZE})
_SQLITE_IS_DAMAGED = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_FORMAT})

TEMPORARY = ".tmp"
"""Suffix of a file that is being written; a map removes such files from its folder when it is opened."""


class Damage(Exception):
    """A file does not hold what was written to it; the text says which file and where."""


def missing(path: Path, error: FileNotFoundError) -> Damage:
    """The error to raise for a missing file: damage, unless the whole folder is missing.

    Raises:
        FileNotFoundError: the folder is missing too; its disk may have been unplugged and can come back.
    """
    if not path.parent.is_dir():
        raise error
    return Damage(f"{path.name}: the file is missing")


def sync_folder(folder: Path) -> None:
    """Make the file names in ``folder`` durable."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make a folder and its missing parents for this user alone, and sync the name of each folder made."""
    if not folder.is_dir():
        make_folder(folder.absolute().parent)
        folder.mkdir(PRIVATE_FOLDER, exist_ok=True)
        sync_folder(folder.absolute().parent)


def sync_file(path: Path) -> None:
    """Make the contents of ``path`` durable."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_at(descriptor: int, data: bytes | memoryview, offset: int) -> None:
    """Write all of ``data`` at ``offset``, in several steps if the system takes only a part at a time."""
    remaining = memoryview(data)
    while remaining:
        written = os.pwrite(descriptor, remaining, offset)
        remaining, offset = remaining[written:], offset + written


@contextmanager
def replacing(path: Path, temporary: Path | None = None, durable: bool = True, private: bool = True) -> Iterator[Path]:
    """Replace the file at ``path`` whole or not at all.

    The block writes a file at the temporary path that it is given.  When the block ends, that file is synced, renamed
    to ``path``, and the folder is synced; when the block raises, the file is removed and ``path`` is as it was.

    Args:
        temporary: where to write; by default ``path`` with the suffix ``.tmp``.
        durable: sync the file and the folder.  A file that can be made again needs no sync.
        private: make the file for this user alone; else the process's umask says for whom it is.

    Raises:
        OSError: the disk refuses.
    """
    temporary = path.with_name(path.name + TEMPORARY) if temporary is None else temporary
    try:
        if private:
            _make_empty(temporary)
        yield temporary
        if durable:
            sync_file(temporary)
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    if durable:
        sync_folder(path.absolute().parent)


def _make_empty(path: Path) -> None:
    descriptor = open_private(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    try:
        os.fchmod(descriptor, PRIVATE_FILE)  # a crash may have left the file of another version
    finally:
        os.close(descriptor)


def write_file(path: Path, data: bytes, private: bool = True) -> None:
    """Put ``data`` at ``path`` whole or not at all, durably; see :func:`replacing`."""
    with replacing(path, private=private) as temporary:
        temporary.write_bytes(data)


def primary_code(error: sqlite3.Error) -> int | None:
    """SQLite's primary result code; None for errors that Python's sqlite3 module raises by itself."""
    code: int | None = getattr(error, "sqlite_errorcode", None)
    return None if code is None else code & 0xFF


def is_full(error: sqlite3.Error) -> bool:
    """Whether SQLite finds no room on the disk."""
    return getattr(error, "sqlite_errorcode", None) in _SQLITE_IS_FULL


def _lacks_descriptors(error: OSError | sqlite3.Error) -> bool:
    if isinstance(error, OSError):
        return error.errno in NO_DESCRIPTOR
    if primary_code(error) != sqlite3.SQLITE_CANTOPEN:
        return False
    try:  # SQLite does not say why it cannot open a file
        os.close(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))
    except OSError as cause:
        return cause.errno in NO_DESCRIPTOR
    return False


def _named(error: OSError | sqlite3.Error, action: str, database: str) -> Exception:
    if _lacks_descriptors(error):
        return TooManyOpenFiles(f"Too many files are open: could not {action}. Try again later.")
    if isinstance(error, OSError):
        if error.errno in DISK_IS_FULL:
            return StorageFull(f"The disk is full ({error.strerror}): could not {action}. Make room and try again.")
        return StorageFailure(f"The disk refused to {action}: {error.strerror or error}.")
    if is_full(error):
        return StorageFull(f"The disk is full: could not {action}. Make room and try again.")
    if primary_code(error) in _SQLITE_IS_DAMAGED or str(error).startswith("Could not decode to UTF-8"):
        return Damage(f"{database} cannot be read: {error}")
    return StorageFailure(f"The disk refused to {action}: {error}.")


@contextmanager
def disk_errors(action: str, database: str = "map.sqlite") -> Iterator[None]:
    """Turn the errors of the file system and of SQLite in the block into ours.

    Args:
        action: the work of the block, as an infinitive for the message.
        database: the SQLite file that the block uses.

    Raises:
        StorageFull: there is no space or quota left, or the file may not grow.
        TooManyOpenFiles: there is no file descriptor left.
        StorageFailure: any other error of the file system or of SQLite.
        Damage: SQLite finds its file damaged.
    """
    try:
        yield
    except PlacerecError:
        raise
    except (sqlite3.IntegrityError, sqlite3.ProgrammingError, sqlite3.InterfaceError):
        raise  # a programming error, not an error of the disk
    except UnicodeDecodeError as error:  # SQLite's message quotes the damaged text
        raise Damage(f"{database} cannot be read: its text is damaged") from error
    except (OSError, sqlite3.Error) as error:
        raise _named(error, action, database) from error


def check_writable(folder: Path) -> None:
    """Write, sync and delete a small file in the data directory.

    Raises:
        StorageFull, StorageFailure: the disk refuses.
    """
    probe = folder / f".probe-{secrets.token_hex(4)}"
    with disk_errors("write to the data directory"):
        try:
            probe.write_bytes(b"\x00" * 4096)
            sync_file(probe)
            sync_folder(folder)
        finally:
            with suppress(OSError):
                probe.unlink()


class FolderLock:
    """Locks a folder for one process by advisory locks: on a file in it, and on the folder itself.

    The file says to people what it is for, and is what other versions lock.  But it can be deleted, and a new one of
    its name is not locked; the folder cannot be deleted while there is something in it.  Where a file system locks no
    folders, the file alone is locked.
    """

    def __init__(self, path: Path) -> None:
        """Take the lock without waiting.

        Raises:
            DataDirectoryLocked: another process holds it.
            OSError: the disk refuses.
        """
        self._descriptors: list[int] = []
        try:
            self._take(path, path.parent, os.O_RDONLY | os.O_DIRECTORY, needed=False)
            self._take(path, path, os.O_RDWR | os.O_CREAT, needed=True)
        except BaseException:
            self.release()
            raise

    def _take(self, path: Path, locked: Path, flags: int, needed: bool) -> None:
        descriptor = os.open(locked, flags | os.O_CLOEXEC, PRIVATE_FILE)
        self._descriptors.append(descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DataDirectoryLocked(
                f"Another process holds {path.parent}: stop it first, or use it with --url."
            ) from error
        except OSError:
            if needed:
                raise

    def release(self) -> None:
        """Release the lock; releasing it again does nothing."""
        while self._descriptors:
            os.close(self._descriptors.pop())
