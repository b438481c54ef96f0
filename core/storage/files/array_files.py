"""Files of arrays that can be made again from the descriptors: codes, and their recall.

A file is little-endian: magic, length of a description (uint32), the description as JSON, the arrays one after the
other, CRC-32 of all before it.  The description names the kind of file, the descriptors from which it was made, and the
type and shape of every array.  A file that is missing, incomplete, damaged or made from something else is stale, and is
made again.
"""

from __future__ import annotations

import json
import logging
import math
import os
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from core.disk.files import replacing

log = logging.getLogger(__name__)

Arrays = Mapping[str, NDArray[Any]]

_MAGIC = b"PLRCARR\x01"
_LENGTH, _CRC = struct.Struct("<I"), struct.Struct("<I")
_LONGEST_DESCRIPTION = 1 << 20
_CHUNK_BYTES = 8 << 20
_KINDS = "buif"


class StaleArrays(Exception):
    """A file of arrays cannot be used; the text says why."""


def write_arrays(path: Path, kind: str, made_of: str, arrays: Arrays) -> bool:
    """Write arrays to ``path``, whole or not at all, durably.  A failure is only logged: nothing depends on the file.

    Args:
        kind, made_of: must be the same when the file is read.

    Returns:
        Whether the file was written.
    """
    listed = [[name, array.dtype.newbyteorder("<").str, list(array.shape)] for name, array in arrays.items()]
    described = json.dumps({"kind": kind, "made_of": made_of, "arrays": listed}).encode()
    try:
        with replacing(path) as temporary, temporary.open("wb") as file:
            running = 0
            for piece in (_MAGIC, _LENGTH.pack(len(described)), described):
                running = _written(file, piece, running)
            for array in arrays.values():
                content = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
                running = _written(file, content.reshape(-1).view(np.uint8).data, running)
            file.write(_CRC.pack(running))
    except OSError as error:
        log.warning("The file %s could not be written and will be made again: %s", path.name, error)
        return False
    return True


def _written(file: BinaryIO, piece: bytes | memoryview, running: int) -> int:
    file.write(piece)
    return zlib.crc32(piece, running)


def read_arrays(path: Path, kind: str, made_of: str) -> dict[str, NDArray[Any]]:
    """The arrays of a file that is complete, of this kind, and made from ``made_of``.

    Raises:
        StaleArrays: it is not.
    """
    return _read_file(path, kind, made_of)[0]


def check_arrays(path: Path, kind: str, made_of: str) -> int:
    """Read and check a file; returns its size in bytes.

    Raises:
        StaleArrays: as for :func:`read_arrays`.
    """
    return _read_file(path, kind, made_of)[1]


def _read_file(path: Path, kind: str, made_of: str) -> tuple[dict[str, NDArray[Any]], int]:
    """The arrays and the size of a file, which may be deleted at any moment."""
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            return _read(file, size, kind, made_of), size
    except FileNotFoundError as error:
        raise StaleArrays("it is missing") from error
    except OSError as error:
        raise StaleArrays(f"it cannot be read: {error.strerror}") from error


def _read(file: BinaryIO, size: int, kind: str, made_of: str) -> dict[str, NDArray[Any]]:
    head = file.read(len(_MAGIC) + _LENGTH.size)
    if len(head) < len(_MAGIC) + _LENGTH.size or head[: len(_MAGIC)] != _MAGIC:
        raise StaleArrays("it is not whole")
    (length,) = _LENGTH.unpack(head[len(_MAGIC) :])
    described = file.read(length) if length <= _LONGEST_DESCRIPTION else b""
    listed = _listed(described, kind, made_of)
    sizes = [dtype.itemsize * math.prod(shape) for _, dtype, shape in listed]
    if size != len(head) + length + sum(sizes) + _CRC.size:
        raise StaleArrays("it is not as long as it says")
    running, found = zlib.crc32(described, zlib.crc32(head)), {}
    for name, dtype, shape in listed:
        array = np.empty(shape, dtype)
        flat = array.reshape(-1).view(np.uint8).data
        for start in range(0, len(flat), _CHUNK_BYTES):
            piece = flat[start : start + _CHUNK_BYTES]
            file.readinto(piece)  # type: ignore[attr-defined]
            running = zlib.crc32(piece, running)
        found[name] = array
    if file.read() != _CRC.pack(running):
        raise StaleArrays("it does not match its checksum")
    return found


def _listed(described: bytes, kind: str, made_of: str) -> list[tuple[str, np.dtype[Any], tuple[int, ...]]]:
    """The arrays that a description names."""
    try:
        content = json.loads(described)
        if content["kind"] != kind:
            raise StaleArrays("it is of another kind")
        if content["made_of"] != made_of:
            raise StaleArrays("it was made of other descriptors")
        listed = [
            (str(name), np.dtype(str(stored)), tuple(map(int, shape))) for name, stored, shape in content["arrays"]
        ]
    except (ValueError, KeyError, TypeError) as error:
        raise StaleArrays("its description cannot be read") from error
    if any(dtype.kind not in _KINDS or min(shape, default=0) < 0 for _, dtype, shape in listed):
        raise StaleArrays("its description makes no sense")
    return listed
