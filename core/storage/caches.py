"""FAISS files of full segments: caches, read instead of the descriptors when a map is opened.

A cache is what ``faiss.write_index`` writes, readable by any FAISS, followed by the segment's local
descriptors as they are and by a trailer that says of which descriptors all that was made and that it
is whole.  One that is missing, stale or damaged is made again from the descriptors.
"""

from __future__ import annotations

import logging
import os
import struct
import zlib
from contextlib import suppress
from pathlib import Path

import faiss
import numpy as np

from core.storage.descriptors import NO_LOCAL, Layout, Local
from core.storage.disk import TEMPORARY, sync_file, sync_folder

log = logging.getLogger(__name__)

# Magic, rows, dimension, with local descriptors their cells and values, and the checksum of the segment;
# behind that the CRC-32 of all before it.
_TRAILER, _LOCAL_TRAILER = struct.Struct("<8sIII"), struct.Struct("<8sIIIII")
_MAGIC, _LOCAL_MAGIC = b"PLRCIDX\x01", b"PLRCIDX\x02"
_CRC = struct.Struct("<I")
_CHUNK_BYTES = 8 << 20


class StaleCache(Exception):
    """A cache cannot be used; the text says why."""


def cache_name(number: int) -> str:
    """File name of the cache of segment ``number``, counted from 0."""
    return f"index-{number + 1:06d}.faiss"


def _trailer(rows: int, dimension: int, local_shape: tuple[int, int], checksum: int) -> bytes:
    """The trailer of a whole cache, but for its last four bytes."""
    if local_shape == NO_LOCAL:
        return _TRAILER.pack(_MAGIC, rows, dimension, checksum)
    return _LOCAL_TRAILER.pack(_LOCAL_MAGIC, rows, dimension, *local_shape, checksum)


def _checksum(path: Path, size: int) -> int:
    running = 0
    with path.open("rb", buffering=0) as file:
        while size > 0 and (chunk := file.read(min(size, _CHUNK_BYTES))):
            running = zlib.crc32(chunk, running)
            size -= len(chunk)
    return running


def check_cache(path: Path, layout: Layout, checksum: int) -> int:
    """Read a cache through without making an index of it.

    Args:
        layout, checksum: of the full segment, as SQLite names it.

    Returns:
        Its size in bytes.

    Raises:
        StaleCache: it is missing, damaged, or was made of other descriptors.
    """
    wanted = _trailer(layout.rows_per_segment, layout.dimension, layout.local_shape, checksum)
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            file.seek(max(0, size - len(wanted) - _CRC.size))
            found = file.read()
        if len(found) != len(wanted) + _CRC.size or found[:8] != wanted[:8]:
            raise StaleCache("it is not whole")
        if found[: len(wanted)] != wanted:
            raise StaleCache("it was made of other descriptors")
        if _CRC.pack(_checksum(path, size - _CRC.size)) != found[len(wanted) :]:
            raise StaleCache("it does not match its checksum")
    except FileNotFoundError as error:
        raise StaleCache("it is missing") from error
    except OSError as error:
        raise StaleCache(f"it cannot be read: {error.strerror}") from error
    return size


def load_cache(path: Path, layout: Layout, checksum: int) -> tuple[faiss.IndexFlatIP, Local]:
    """The index of a full segment and its local descriptors, int8 [n, C, L], from its cache.

    Raises:
        StaleCache: it is missing, damaged, or was made of other descriptors.
    """
    # FAISS believes what a file says of its sizes, so nothing reaches it that was not checked.
    size = check_cache(path, layout, checksum)
    rows, dimension, shape = layout.rows_per_segment, layout.dimension, layout.local_shape
    try:
        index = faiss.read_index(str(path))
        local = _read_local(path, size, (rows, *shape))
    except RuntimeError as error:
        raise StaleCache("FAISS cannot read it") from error
    except OSError as error:
        raise StaleCache(f"it cannot be read: {error.strerror}") from error
    if not isinstance(index, faiss.IndexFlatIP) or (index.ntotal, index.d) != (rows, dimension):
        raise StaleCache("it holds another kind of index")
    return index, local


def _read_local(path: Path, size: int, shape: tuple[int, int, int]) -> Local:
    """The local descriptors of a checked cache of ``size`` bytes: the last thing before its trailer."""
    count = shape[0] * shape[1] * shape[2]
    behind = _CRC.size + (_LOCAL_TRAILER.size if count else _TRAILER.size)
    return np.fromfile(path, np.int8, count, offset=size - behind - count).reshape(shape)


def write_cache(path: Path, index: faiss.IndexFlatIP, local: Local, checksum: int) -> None:
    """Write the cache of a full segment; a failure is logged, for nothing depends on it.

    Args:
        index, local: n descriptors, and int8 [n, C, L].
        checksum: the segment's.
    """
    temporary = path.with_name(path.name + TEMPORARY)
    try:
        faiss.write_index(index, str(temporary))
        with temporary.open("ab") as file:
            file.write(np.ascontiguousarray(local).data)
            file.write(_trailer(index.ntotal, index.d, local.shape[1:], checksum))
        whole = _checksum(temporary, temporary.stat().st_size)
        with temporary.open("ab") as file:
            file.write(_CRC.pack(whole))
        sync_file(temporary)
        os.replace(temporary, path)
        sync_folder(path.parent)
    except (OSError, RuntimeError) as error:
        log.warning("The cache %s could not be written and will be made again: %s", path.name, error)
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
