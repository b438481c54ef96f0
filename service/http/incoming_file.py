"""A file that is written while a request body arrives, and that gets its final name once it is complete."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

from core.storage.files.disk import sync_folder, write_at


class IncomingFile:
    """A file that is being written; it may be used from one thread at a time.

    Methods raise OSError.  After a crash an incomplete file is found under its temporary name.

    Args:
        temporary: the path until the file is complete; a folder if ``name`` is given.
        final: the path from then on.
        name: the name of the file in the folder; None if ``temporary`` is the file itself.
    """

    def __init__(self, temporary: Path, final: Path, name: str | None = None) -> None:
        self.temporary, self.final = temporary, final
        self._path = temporary if name is None else temporary / name
        self.descriptor = -1
        self.size = 0
        """Bytes that :meth:`write` has appended."""

    def open(self) -> None:
        """Create the file, in a folder that exists."""
        self.descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)

    def write(self, data: bytes) -> None:
        """Append bytes."""
        write_at(self.descriptor, data, self.size)
        self.size += len(data)

    def complete(self) -> None:
        """Sync the file, give it its final name, and sync the folders above it."""
        os.fsync(self.descriptor)
        os.rename(self.temporary, self.final)
        sync_folder(self.final.parent)
        sync_folder(self.final.parent.parent)
        self._close()

    def discard(self) -> None:
        """Remove what there is of the file, under either name; errors are ignored."""
        self._close()
        for path in (self.temporary, self.final):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                with suppress(OSError):
                    path.unlink(missing_ok=True)

    def _close(self) -> None:
        descriptor, self.descriptor = self.descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)
