"""Permissions of files and folders: what is stored is for the user alone whose process stores it.

Files and folders are made so, whatever the process's umask is.  Those of before are closed when a folder is taken into
use.
"""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

PRIVATE_FILE = 0o600
PRIVATE_FOLDER = 0o700

_OTHERS = stat.S_IRWXG | stat.S_IRWXO
_WRITERS = stat.S_IWGRP | stat.S_IWOTH

log = logging.getLogger(__name__)


def open_private(path: str | Path, flags: int) -> int:
    """A descriptor of a file, which is made for this user alone if it is missing; also an ``opener`` of ``open``.

    Raises:
        OSError: the disk refuses.
    """
    return os.open(path, flags | os.O_CLOEXEC, PRIVATE_FILE)


def make_private(path: Path) -> None:
    """Make an empty file for this user alone, unless there is one, which is neither opened nor changed.

    Closing a file drops the locks that other parts of the process have on it, as SQLite has.

    Raises:
        OSError: the disk refuses.
    """
    with suppress(FileExistsError):
        os.close(open_private(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL))


def close_to_others(folder: Path, but: frozenset[str] = frozenset()) -> None:
    """Take from others what they may do with a folder, and with what is in it.

    A folder that others cannot enter is left as it is.  What belongs to another user cannot be closed, and a warning
    says so.  Links are not followed.

    Args:
        but: names of files in it that are left as they are if others may write to them: whoever reads them refuses
            them, because others may have done so.

    Raises:
        OSError: the folder cannot be read.
    """
    if not stat.S_IMODE(folder.stat().st_mode) & _OTHERS:
        return
    closed, foreign = 0, []
    for path in _within(folder):
        with suppress(FileNotFoundError):
            status = path.lstat()
            if not status.st_mode & _OTHERS or not (stat.S_ISDIR(status.st_mode) or stat.S_ISREG(status.st_mode)):
                continue
            if path.name in but and path.parent == folder and status.st_mode & _WRITERS:
                continue
            try:
                if status.st_uid != os.geteuid():
                    raise PermissionError
                os.chmod(path, stat.S_IMODE(status.st_mode) & ~_OTHERS)
                closed += 1
            except OSError:
                foreign.append(path)
    if closed:
        log.warning("others could read %s: %d files and folders are closed to them now", folder, closed)
    if foreign:
        log.warning(
            "others can read %s and %d more, which cannot be closed to them: see to their owner and mode",
            foreign[-1],
            len(foreign) - 1,
        )


def _within(folder: Path) -> Iterator[Path]:
    """Everything in a folder on the same disk, and last the folder, so that a crash before does not make it look done.

    Raises:
        OSError: the folder cannot be read.
    """
    device = folder.stat().st_dev
    list(os.scandir(folder))  # os.walk would not say that it cannot be read
    for parent, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if _is_on(Path(parent, name), device)]
        yield from (Path(parent, name) for name in (*files, *folders))
    yield folder


def _is_on(path: Path, device: int) -> bool:
    try:
        status = path.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode) and status.st_dev == device
