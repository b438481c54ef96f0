"""Room on a disk that is held back, so that what is on it can still be read and deleted when it is full.

A deletion writes before anything is freed: a database notes it in its log.  So on a disk without a free byte nothing
could be deleted by those who want to make room.  A database that is opened needs a little room as well, be it for
reading alone: for the index of its log, which lies in a file beside it.
"""

from __future__ import annotations

import logging
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from core.disk.permissions import open_private
from core.errors import StorageFull

FILE = "RESERVE"

ROOMY = 4
"""The reserve is made where so many times its size is free."""

LENT = 256 << 10
"""Bytes that are freed for what opens a database."""

T = TypeVar("T")

_lenders: set[Path] = set()

log = logging.getLogger(__name__)


def lend_from(folder: Path) -> None:
    """Have the reserve of a folder lend room to databases in it that are opened; the folder is this process's own."""
    _lenders.add(folder.absolute())


@contextmanager
def lent_to(path: Path) -> Iterator[bool]:
    """Free a little of the room that is held back above a file, for the block; whether there was any."""
    found = next((folder / FILE for folder in path.absolute().parents if folder in _lenders), None)
    size = 0
    with suppress(OSError):
        if found is not None and (size := found.stat().st_size):
            os.truncate(found, max(0, size - LENT))
            log.warning("the disk is full: %s is opened with room that is held back", path.name)
    yield size > 0
    with suppress(OSError):
        if found is not None and size:  # what is left of it is held back again
            left = shutil.disk_usage(found.parent).free
            with found.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, min(size, os.fstat(file.fileno()).st_size + left))


class Reserve:
    """A file that takes up room.  Any thread may use it.

    Args:
        folder: in which it is.
        size: in bytes; 0: there is none.
    """

    def __init__(self, folder: Path, size: int) -> None:
        self._path, self._size = folder / FILE, size
        self._lock = threading.Lock()

    def hold(self) -> bool:
        """Make the file as large as it is to be, if there is plenty of room; returns whether it is."""
        with self._lock:
            if not self._size:
                self._path.unlink(missing_ok=True)
                return False
            with suppress(OSError):
                if self._path.stat().st_size == self._size:
                    return True
            return self._free() >= ROOMY * self._size and self._take(self._size)

    def making_room(self, work: Callable[[], T]) -> T:
        """Do something that deletes; if the disk is full, again with the room of the reserve.

        Of that room, what is left is held again.

        Raises:
            StorageFull: the room does not suffice, or there is none.
            Others: what the work raises.
        """
        try:
            return work()
        except StorageFull:
            if not self._release():
                raise
            log.warning("the disk is full: the room that is held back is used to delete")
            try:
                return work()
            finally:
                with self._lock:
                    self._take(min(self._size, self._free()))

    def _free(self) -> int:
        try:
            return shutil.disk_usage(self._path.parent).free
        except OSError:
            return 0

    def _release(self) -> bool:
        with self._lock:
            try:
                self._path.unlink()
            except OSError:
                return False
            return True

    def _take(self, size: int) -> bool:
        """Make the file, of so many bytes that the disk really has."""
        if size <= 0:
            return False
        try:
            file = open_private(self._path, os.O_WRONLY | os.O_CREAT)
            try:
                os.ftruncate(file, 0)
                os.posix_fallocate(file, 0, size)
            finally:
                os.close(file)
        except OSError as error:
            log.warning("no room is held back to delete with when the disk is full: %s", error.strerror)
            with suppress(OSError):
                self._path.unlink()
            return False
        return True
