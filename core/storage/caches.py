"""FAISS files of full segments: caches, read instead of the descriptors when a map is opened.

A cache is what ``faiss.write_index`` writes, readable by any FAISS, followed by a trailer that says
of which descriptors it was made and that it is whole.  One that is missing, stale or damaged is
made again from the descriptors.
"""

from __future__ import annotations

import logging
import os
import struct
import zlib
from contextlib import suppress
from pathlib import Path

import faiss

from core.storage.disk import TEMPORARY, sync_file, sync_folder

log = logging.getLogger(__name__)

_TRAILER = struct.Struct("<8sIIII")  # magic, rows, dimension, checksum of the segment, CRC-32 of all before it
_MAGIC = b"PLRCIDX\x01"
_CHUNK_BYTES = 8 << 20


class StaleCache(Exception):
    """A cache cannot be used; the text says why."""


def cache_name(number: int) -> str:
    """File name of the cache of segment ``number``, counted from 0."""
    return f"index-{number + 1:06d}.faiss"


def _checksum(path: Path, size: int) -> int:
    running = 0
    with path.open("rb", buffering=0) as file:
        while size > 0 and (chunk := file.read(min(size, _CHUNK_BYTES))):
            running = zlib.crc32(chunk, running)
            size -= len(chunk)
    return running


def check_cache(path: Path, rows: int, dimension: int, checksum: int) -> int:
    """Read a cache through without making an index of it.

    Args:
        rows, dimension, checksum: of the segment as SQLite names it.

    Returns:
        Its size in bytes.

    Raises:
        StaleCache: it is missing, damaged, or was made of other descriptors.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            file.seek(max(0, size - _TRAILER.size))
            trailer = file.read()
        if len(trailer) != _TRAILER.size or trailer[:8] != _MAGIC:
            raise StaleCache("it is not whole")
        _, found_rows, found_dimension, found_checksum, whole = _TRAILER.unpack(trailer)
        if (found_rows, found_dimension, found_checksum) != (rows, dimension, checksum):
            raise StaleCache("it was made of other descriptors")
        if _checksum(path, size - 4) != whole:
            raise StaleCache("it does not match its checksum")
    except FileNotFoundError as error:
        raise StaleCache("it is missing") from error
    except OSError as error:
        raise StaleCache(f"it cannot be read: {error.strerror}") from error
    return size


def load_cache(path: Path, rows: int, dimension: int, checksum: int) -> faiss.IndexFlatIP:
    """The index of a full segment, from its cache.

    Raises:
        StaleCache: it is missing, damaged, or was made of other descriptors.
    """
    # FAISS believes what a file says of its sizes, so nothing reaches it that was not checked.
    check_cache(path, rows, dimension, checksum)
    try:
        index = faiss.read_index(str(path))
    except RuntimeError as error:
        raise StaleCache("FAISS cannot read it") from error
    if not isinstance(index, faiss.IndexFlatIP) or (index.ntotal, index.d) != (rows, dimension):
        raise StaleCache("it holds another kind of index")
    return index


def write_cache(path: Path, index: faiss.IndexFlatIP, checksum: int) -> None:
    """Write the cache of a full segment; a failure is logged, for nothing depends on it."""
    temporary = path.with_name(path.name + TEMPORARY)
    try:
        faiss.write_index(index, str(temporary))
        size = temporary.stat().st_size
        fixed = _TRAILER.pack(_MAGIC, index.ntotal, index.d, checksum, 0)[:-4]
        with temporary.open("ab") as file:
            file.write(fixed)
        whole = _checksum(temporary, size + len(fixed))
        with temporary.open("ab") as file:
            file.write(struct.pack("<I", whole))
        sync_file(temporary)
        os.replace(temporary, path)
        sync_folder(path.parent)
    except (OSError, RuntimeError) as error:
        log.warning("The cache %s could not be written and will be made again: %s", path.name, error)
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
