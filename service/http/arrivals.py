"""Files that are written to disk while a request's body arrives, and get their final name only when they are complete.

Until then the name begins with a dot, so that nothing that a crash leaves is taken for a complete file.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from core.disk.files import disk_errors, sync_folder
from core.disk.permissions import PRIVATE_FOLDER
from service.worker_threads import to_its_end


class Arrival:
    """A new file under a random name, open for reading and writing; for one thread at a time.

    Args:
        folder: where it is to lie; made if it is missing.
        action: the action, for error messages, such as "store the map".
        inside: name of the file within a folder of its own; if left out it lies directly in ``folder``.
    """

    def __init__(self, folder: Path, action: str, inside: str | None = None) -> None:
        self.name = secrets.token_hex(8)
        self.temporary, self.final = folder / f".{self.name}", folder / self.name
        self.file = -1
        """The file's descriptor while it is open."""
        self._action, self._inside = action, inside

    def open(self, check_room: Callable[[], None]) -> None:
        """Make the file.

        Args:
            check_room: raises if the disk has no room; called when ``folder`` exists.

        Raises:
            StorageFull, StorageFailure: the disk refuses.
        """
        with disk_errors(self._action):
            self.temporary.parent.mkdir(PRIVATE_FOLDER, parents=True, exist_ok=True)
            check_room()
            path = self.temporary
            if self._inside is not None:
                path.mkdir(PRIVATE_FOLDER)
                path = path / self._inside
            self.file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)

    def complete(self) -> int:
        """Sync the file, give it its final name, and close it; returns its size in bytes.

        Raises:
            StorageFull, StorageFailure: the disk refuses.
        """
        with disk_errors(self._action):
            os.fsync(self.file)
            size = os.fstat(self.file).st_size
            os.rename(self.temporary, self.final)
            sync_folder(self.final.parent)
            sync_folder(self.final.parent.parent)
        self._close()
        return size

    def discard(self) -> None:
        """Close the file and remove it, whichever name it has."""
        self._close()
        for path in (self.temporary, self.final):
            if self._inside is not None:
                shutil.rmtree(path, ignore_errors=True)
            else:
                with suppress(OSError):
                    path.unlink(missing_ok=True)

    def _close(self) -> None:
        file, self.file = self.file, -1
        if file >= 0:
            os.close(file)


@asynccontextmanager
async def arriving(arrival: Arrival, check_room: Callable[[], None]) -> AsyncIterator[None]:
    """Open an arrival, and discard it if the block raises.

    The block must not leave a thread behind that writes to the file: see :func:`service.worker_threads.to_its_end`.

    Raises:
        StorageFull, StorageFailure: the disk refuses.
        Others: errors of ``check_room``.
    """
    try:
        await to_its_end(lambda: arrival.open(check_room))
        yield
    except BaseException:
        await to_its_end(arrival.discard)
        raise
