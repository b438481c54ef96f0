"""Writing a report's files so that a failure leaves no half page."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from core.errors import StorageFailure, StorageFull


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write all files under temporary names, then give them theirs, in their order.

    The folder is made where it is missing; files of other names in it stay.  The last file should
    be the one that refers to the others.

    Raises:
        StorageFull: the disk is full; no file was changed.
        StorageFailure: the folder cannot be made or written to; unless it fails while files are
            renamed, no file was changed.
    """
    written: dict[Path, Path] = {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            partial = folder / f".{name}.{os.getpid()}.tmp"
            written[partial] = folder / name
            partial.write_bytes(data)
        for partial, final in written.items():
            os.replace(partial, final)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise StorageFull(f"The disk is full: the report in {folder} was not written.") from error
        raise StorageFailure(f"The report cannot be written to {folder}: {error.strerror}.") from error
    finally:
        for partial in written:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
