"""Descriptors on disk: append-only segment files, the truth from which every index can be made again.

A segment file is a header of 4 096 bytes and records of one size, so that it can be mapped into
memory as it is (:func:`map_records`):

    header   magic, version, dtype, dimension, rows of a full segment, first row, length of the encoder
             identity; in version 2 the cells and the values a cell of the local descriptors; the
             identity, zeros, CRC-32 of all before it
    record   descriptor (float32 [D]), in version 2 local descriptors (int8 [C, L]), row (uint64),
             CRC-32 of descriptors and row (uint32), zeros (uint32)

Maps whose encoder has no second stage are of version 1, which is version 2 without local descriptors.
Row r of a map is record ``r % rows_per_segment`` of segment ``r // rows_per_segment``.  Only as many
records count as SQLite names; what stands behind them was never acknowledged and is overwritten.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.storage.disk import Damage, sync_folder, write_at

Descriptor = NDArray[np.float32]
Local = NDArray[np.int8]
"""Local descriptors of one frame, [C, L]; [0, 0] where the encoder has no second stage."""

NO_LOCAL = (0, 0)
"""Shape of the local descriptors of an encoder that has none."""

ROWS_PER_SEGMENT = 256
"""Rows of a full segment of a new map: some tens of megabytes of the default encoder's descriptors."""

HEADER_BYTES = 4096
_HEADER = struct.Struct("<8sI8sIIQH")
_LOCAL_SHAPE = struct.Struct("<II")
_MAGIC, _VERSION, _LOCAL_VERSION, _DTYPE = b"PLRCSEG\x00", 1, 2, b"<f4"
_IDENTITY_BYTES = 1024
_CHUNK_BYTES = 8 << 20


@dataclass(frozen=True)
class Layout:
    """What all segment files of a map have in common; ``local_shape`` is (C, L)."""

    dimension: int
    identity: str
    rows_per_segment: int
    local_shape: tuple[int, int] = NO_LOCAL

    def __post_init__(self) -> None:
        if len(self.identity.encode()) > _IDENTITY_BYTES:
            raise ValueError(f"an encoder identity has at most {_IDENTITY_BYTES} bytes")
        if self.local_shape != NO_LOCAL and min(self.local_shape) < 1:
            raise ValueError(f"local descriptors of {self.local_shape} cells and values make no sense")

    @property
    def record(self) -> np.dtype[np.void]:
        """The structured type of one record."""
        return np.dtype(
            [
                ("descriptor", "<f4", (self.dimension,)),
                ("local", "i1", self.local_shape),
                ("row", "<u8"),
                ("checksum", "<u4"),
                ("reserved", "<u4"),
            ]
        )

    def header(self, number: int) -> bytes:
        """The first 4 096 bytes of segment ``number``."""
        identity = self.identity.encode()
        first_row = number * self.rows_per_segment
        has_local = self.local_shape != NO_LOCAL
        version = _LOCAL_VERSION if has_local else _VERSION
        fixed = _HEADER.pack(_MAGIC, version, _DTYPE, self.dimension, self.rows_per_segment, first_row, len(identity))
        shape = _LOCAL_SHAPE.pack(*self.local_shape) if has_local else b""
        content = (fixed + shape + identity).ljust(HEADER_BYTES - 4, b"\x00")
        return content + struct.pack("<I", zlib.crc32(content))


def segment_name(number: int) -> str:
    """File name of segment ``number``, counted from 0."""
    return f"descriptors-{number + 1:06d}.seg"


def row_checksum(descriptor: Descriptor, local: Local, row: int) -> int:
    """CRC-32 over the bytes of a frame's descriptors and its row: a record in the wrong place does not pass."""
    running = zlib.crc32(np.ascontiguousarray(descriptor, dtype="<f4").data)
    running = zlib.crc32(np.ascontiguousarray(local, dtype="i1").data, running)
    return zlib.crc32(struct.pack("<Q", row), running)


def chain(checksums: ArrayLike, before: int = 0) -> int:
    """The checksum of a segment: CRC-32 over those of its rows, continued from ``before``."""
    return zlib.crc32(np.asarray(checksums, dtype="<u4").tobytes(), before)


def _check_header(path: Path, found: bytes, layout: Layout, number: int) -> None:
    if found == layout.header(number):
        return
    if len(found) < HEADER_BYTES:
        raise Damage(f"{path.name}: the file ends within its header")
    if struct.unpack("<I", found[-4:])[0] != zlib.crc32(found[:-4]):
        raise Damage(f"{path.name}: the header does not match its checksum")
    raise Damage(f"{path.name}: the header is that of another map, encoder, segment or version")


def read_records(folder: Path, layout: Layout, number: int, rows: int) -> Iterator[NDArray[np.void]]:
    """The first ``rows`` records of a segment, a few megabytes at a time; not yet checked.

    Raises:
        Damage: the file is missing, too short, or its header is not what it must be.
        OSError: the disk refuses.
    """
    path = folder / segment_name(number)
    try:
        file = path.open("rb", buffering=0)
    except FileNotFoundError as error:
        raise Damage(f"{path.name}: the file is missing") from error
    with file:
        _check_header(path, file.read(HEADER_BYTES), layout, number)
        step = max(1, _CHUNK_BYTES // layout.record.itemsize)
        for start in range(0, rows, step):
            records = np.empty(min(step, rows - start), dtype=layout.record)
            view = records.view(np.uint8).data
            filled = 0
            while filled < len(view):
                got = file.readinto(view[filled:])
                if not got:
                    whole = start + filled // layout.record.itemsize
                    raise Damage(f"{path.name}: the file ends after {whole} of {rows} rows")
                filled += got
            yield records


def damaged_rows(records: NDArray[np.void], first_row: int) -> list[int]:
    """Those of consecutive records, the first of which is ``first_row``, that fail their checksum."""
    damaged = []
    for offset, record in enumerate(records):
        row = first_row + offset
        if record["row"] != row or record["checksum"] != row_checksum(record["descriptor"], record["local"], row):
            damaged.append(row)
    return damaged


def read_checked(folder: Path, layout: Layout, number: int, rows: int, checksum: int) -> Iterator[NDArray[np.void]]:
    """Like :func:`read_records`, every record checked, and the segment as a whole at the end.

    Raises:
        Damage: a row fails its checksum, or all pass but they are not those that were named.
    """
    row, running = number * layout.rows_per_segment, 0
    for records in read_records(folder, layout, number, rows):
        if damaged := damaged_rows(records, row):
            raise Damage(f"{segment_name(number)}: row {damaged[0]} does not match its checksum")
        running = chain(records["checksum"], running)
        row += len(records)
        yield records
    if running != checksum:
        raise Damage(f"{segment_name(number)}: the rows are not those that map.sqlite names")


def map_records(folder: Path, layout: Layout, number: int, rows: int) -> np.memmap[tuple[int], np.dtype[np.void]]:
    """The first ``rows`` records of a segment as memory that the system reads when it is touched; unchecked."""
    return np.memmap(folder / segment_name(number), dtype=layout.record, mode="r", offset=HEADER_BYTES, shape=(rows,))


def append(
    folder: Path, layout: Layout, first_row: int, descriptors: Sequence[Descriptor], local: Sequence[Local]
) -> list[int]:
    """Write frames behind the ``first_row`` rows there are, and sync every file and folder touched.

    Args:
        descriptors, local: of the same n frames, float32 [D] and int8 [C, L] each.

    Returns:
        The checksum of each row.

    Raises:
        OSError: the disk refuses; what it holds behind ``first_row`` is then unknown (:func:`rewind`).
    """
    checksums: list[int] = []
    while len(checksums) < len(descriptors):
        row = first_row + len(checksums)
        number, offset = divmod(row, layout.rows_per_segment)
        batch = slice(len(checksums), len(checksums) + layout.rows_per_segment - offset)
        frames = list(zip(descriptors[batch], local[batch], strict=True))
        records = np.zeros(len(frames), dtype=layout.record)
        for i, (descriptor, cells) in enumerate(frames):
            records[i] = (descriptor, cells, row + i, row_checksum(descriptor, cells, row + i), 0)
        _write(folder / segment_name(number), layout, number, offset, records)
        checksums += records["checksum"].tolist()
    return checksums


def _write(path: Path, layout: Layout, number: int, offset: int, records: NDArray[np.void]) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        if offset == 0:
            write_at(descriptor, layout.header(number), 0)
        write_at(descriptor, records.view(np.uint8).data, HEADER_BYTES + offset * layout.record.itemsize)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    if offset == 0:
        sync_folder(path.parent)


def rewind(folder: Path, layout: Layout, rows: int) -> None:
    """Leave nothing behind the first ``rows`` rows: cut the last segment, remove those that follow it.

    Raises:
        OSError: the disk refuses.
    """
    number, offset = divmod(rows, layout.rows_per_segment)
    for name in os.listdir(folder):
        found = re.fullmatch(r"descriptors-(\d{6,})\.seg", name)
        if found and int(found[1]) - 1 >= number + (offset > 0):
            (folder / name).unlink()
    if offset:
        end = HEADER_BYTES + offset * layout.record.itemsize
        with suppress(FileNotFoundError), (folder / segment_name(number)).open("r+b") as file:
            if os.fstat(file.fileno()).st_size > end:
                file.truncate(end)
                os.fsync(file.fileno())
