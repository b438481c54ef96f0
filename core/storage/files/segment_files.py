"""Segment files: the descriptors of a map, append-only, with a checksum for every row.

A file is little-endian: a header of 4 096 bytes followed by records (see `Layout.record`):

    header   magic, version, format of the descriptors, dimension, rows of a full segment, first row, length of the
             encoder identity, the cells and the values per cell of the local descriptors, the encoder identity,
             zeros, CRC-32 of all before it
    record   stored descriptor, row (uint64), checksum of the record (uint32), CRC-32 of descriptor and row (uint32),
             CRC-32 of local descriptors and row (uint32), zeros (uint32; in an erased record its mark), stored local
             descriptors

The checksum of a record is the CRC-32 of its two other checksums, so that the descriptor and the local descriptors can
each be read and checked without the other; both are stored in the map's precision (:data:`Precision`).  The version is
3, which all releases have written.

Row r of a map is record ``r % rows_per_segment`` of segment ``r // rows_per_segment``.  SQLite says how many records
count; any that follow were never acknowledged and are overwritten.

The record of a row without a place may be *erased*: its descriptors are zeros, its row and its checksums stay, so that
the checksum of the segment does, and a mark stands in the place of the last zeros.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.disk.files import Damage, missing, sync_folder, write_at
from core.disk.permissions import open_private
from core.maps.records import Precision
from core.storage.files.row_formats import (
    HALF,
    Descriptor,
    Local,
    pack_descriptors,
    pack_local,
    resting_types,
    unpack_descriptors,
    unpack_local,
)

NO_LOCAL = (0, 0)
"""Shape of the local descriptors of an encoder that has none."""

ROWS_PER_SEGMENT = 1024
"""Rows of a full segment of a new map: 64 MB of the default encoder's descriptors, a thousand files at a million."""

HEADER_BYTES = 4096
_HEADER = struct.Struct("<8sI8sIIQH")
_LOCAL_SHAPE = struct.Struct("<II")
_MAGIC = b"PLRCSEG\x00"
_VERSION = 3
_CODES: dict[Precision, bytes] = {"half": b"<f2", "compressed": b"6 bits"}
_IDENTITY_BYTES = 1024
_CHUNK_BYTES = 8 << 20

ERASING, ERASED = 0x53415245, 0x454E4F47
"""The marks of a record whose descriptors are being overwritten, and are overwritten, with zeros."""


@dataclass(frozen=True)
class Layout:
    """The layout that all segment files of a map share; ``local_shape`` is (C, L), the shape of local descriptors."""

    dimension: int
    identity: str
    rows_per_segment: int
    local_shape: tuple[int, int] = NO_LOCAL
    precision: Precision = HALF

    def __post_init__(self) -> None:
        if len(self.identity.encode()) > _IDENTITY_BYTES:
            raise ValueError(f"an encoder identity has at most {_IDENTITY_BYTES} bytes")
        if self.local_shape != NO_LOCAL and min(self.local_shape) < 1:
            raise ValueError(f"local descriptors cannot have {self.local_shape} cells and values")

    @cached_property
    def record(self) -> np.dtype[np.void]:
        """The structured type of one record."""
        descriptor, local = resting_types(self.precision, self.dimension, self.local_shape)
        sums = [("checksum", "<u4"), ("of_descriptor", "<u4"), ("of_local", "<u4"), ("reserved", "<u4")]
        return np.dtype([("descriptor", *descriptor), ("row", "<u8"), *sums, ("local", *local)])

    def header(self, number: int) -> bytes:
        """The first 4 096 bytes of segment ``number``."""
        identity = self.identity.encode()
        first_row = number * self.rows_per_segment
        fixed = _HEADER.pack(
            _MAGIC, _VERSION, _CODES[self.precision], self.dimension, self.rows_per_segment, first_row, len(identity)
        )
        content = (fixed + _LOCAL_SHAPE.pack(*self.local_shape) + identity).ljust(HEADER_BYTES - 4, b"\x00")
        return content + struct.pack("<I", zlib.crc32(content))

    def pack(self, record: np.void, descriptor: Descriptor, local: Local, row: int) -> None:
        """Fill a record of zeros with a frame's descriptors, float32 [D] and int8 [C, L], and their checksums."""
        record["descriptor"] = pack_descriptors(descriptor[np.newaxis], self.precision)[0]
        record["local"] = pack_local(local[np.newaxis], self.precision)[0]
        self._complete(record, row)

    @cached_property
    def frame(self) -> np.dtype[np.void]:
        """The structured type of a frame's stored descriptors, without the row and the checksums of a record."""
        descriptor, local = resting_types(self.precision, self.dimension, self.local_shape)
        return np.dtype([("descriptor", *descriptor), ("local", *local)])

    def records_of(self, frames: NDArray[np.void], first_row: int) -> NDArray[np.void]:
        """Records with checksums of stored descriptors (:attr:`frame`) for the rows from ``first_row`` on."""
        records = np.zeros(len(frames), dtype=self.record)
        for name in ("descriptor", "local"):
            records[name] = frames[name]
        for row, record in enumerate(records, start=first_row):
            self._complete(record, row)
        return records

    def _complete(self, record: np.void, row: int) -> None:
        record["row"] = row
        record["of_descriptor"], record["of_local"] = self.part_checksums(record, row)
        record["checksum"] = self.row_checksum(record, row)

    def part_checksums(self, record: np.void, row: int) -> tuple[int, int]:
        """CRC-32 of a record's descriptor with the row, and of its local descriptors with the row."""
        place = struct.pack("<Q", row)
        descriptor, local = (np.ascontiguousarray(record[name]).tobytes() for name in ("descriptor", "local"))
        return zlib.crc32(place, zlib.crc32(descriptor)), zlib.crc32(place, zlib.crc32(local))

    def row_checksum(self, record: np.void, row: int) -> int:
        """The checksum that ``record`` has as that of ``row``; a record in the wrong place does not match it."""
        return zlib.crc32(struct.pack("<II", *self.part_checksums(record, row)))

    def is_sound(self, record: np.void, row: int) -> bool:
        """Whether a record is of ``row`` and matches its checksums."""
        if record["row"] != row or record["checksum"] != self.row_checksum(record, row):
            return False
        return (int(record["of_descriptor"]), int(record["of_local"])) == self.part_checksums(record, row)

    def is_erased(self, record: np.void, row: int) -> bool:
        """Whether a record of ``row`` is marked as erased, or about to be, and its checksums stayed as they were."""
        sums = struct.pack("<II", record["of_descriptor"], record["of_local"])
        marked = record["reserved"] in (ERASING, ERASED)
        return bool(marked and record["row"] == row and record["checksum"] == zlib.crc32(sums))

    def descriptors_of(self, records: NDArray[np.void]) -> NDArray[np.float32]:
        """The descriptors of records, which are searched: float32 [n, D]."""
        return unpack_descriptors(records["descriptor"], self.precision, self.dimension)

    def locals_of(self, records: NDArray[np.void]) -> Local:
        """The local descriptors of records, which the second stage compares: int8 [n, C, L]."""
        return unpack_local(records["local"], self.precision, self.local_shape)


def segment_name(number: int) -> str:
    """File name of segment ``number``, counted from 0."""
    return f"descriptors-{number + 1:06d}.seg"


def segment_checksum(checksums: ArrayLike, before: int = 0) -> int:
    """The checksum of a segment: CRC-32 of the checksums of its rows, continued from ``before``."""
    return zlib.crc32(np.asarray(checksums, dtype="<u4").tobytes(), before)


def check_header(path: Path, found: bytes, layout: Layout, number: int) -> None:
    """Raise Damage unless ``found`` is the header of a segment."""
    if found == layout.header(number):
        return
    if len(found) < HEADER_BYTES:
        raise Damage(f"{path.name}: the file ends within its header")
    if struct.unpack("<I", found[-4:])[0] != zlib.crc32(found[:-4]):
        raise Damage(f"{path.name}: the header does not match its checksum")
    raise Damage(f"{path.name}: the header is that of another map, encoder, segment or version")


def read_records(folder: Path, layout: Layout, number: int, rows: int) -> Iterator[NDArray[np.void]]:
    """The first ``rows`` records of a segment, a few megabytes at a time, without checking them.

    Raises:
        Damage: the file is missing, too short, or its header is wrong.
        OSError: the disk refuses.
    """
    path = folder / segment_name(number)
    try:
        file = path.open("rb", buffering=0)
    except FileNotFoundError as error:
        raise missing(path, error) from error
    with file:
        check_header(path, file.read(HEADER_BYTES), layout, number)
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


def damaged_rows(layout: Layout, records: NDArray[np.void], first_row: int) -> list[int]:
    """The rows of consecutive records from ``first_row`` on that do not match their checksum, and are not erased."""
    numbered = enumerate(records, start=first_row)
    return [row for row, record in numbered if not (layout.is_sound(record, row) or layout.is_erased(record, row))]


def erased_rows(records: NDArray[np.void], first_row: int) -> list[int]:
    """The rows of consecutive records from ``first_row`` on that are erased, or about to be."""
    marked = np.isin(records["reserved"], (ERASING, ERASED))
    return [first_row + int(offset) for offset in np.flatnonzero(marked)]


def read_checked(folder: Path, layout: Layout, number: int, rows: int, checksum: int) -> Iterator[NDArray[np.void]]:
    """Like :func:`read_records`, with every record checked, and the segment as a whole at the end.

    Raises:
        Damage: a row does not match its checksum, or all do but they are not those of ``checksum``.
    """
    row, running = number * layout.rows_per_segment, 0
    for records in read_records(folder, layout, number, rows):
        if damaged := damaged_rows(layout, records, row):
            raise Damage(f"{segment_name(number)}: row {damaged[0]} does not match its checksum")
        running = segment_checksum(records["checksum"], running)
        row += len(records)
        yield records
    if running != checksum:
        raise Damage(f"{segment_name(number)}: the rows are not those that map.sqlite records")


def append(folder: Path, layout: Layout, first_row: int, records: NDArray[np.void]) -> None:
    """Append records to the ``first_row`` rows of a map, and sync the files and the folder.

    Raises:
        OSError: the disk refuses; the content of the files from ``first_row`` on is then unknown (:func:`rewind`).
    """
    done = 0
    while done < len(records):
        number, offset = divmod(first_row + done, layout.rows_per_segment)
        batch = records[done : done + layout.rows_per_segment - offset]
        _write(folder / segment_name(number), layout, number, offset, batch)
        done += len(batch)


def _write(path: Path, layout: Layout, number: int, offset: int, records: NDArray[np.void]) -> None:
    descriptor = open_private(path, os.O_WRONLY | os.O_CREAT)
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
    """Cut the segment files of a map to its first ``rows`` rows.

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


def erase(folder: Path, layout: Layout, number: int, offsets: Sequence[int]) -> int:
    """Overwrite the descriptors of records of a segment, which no place has and nobody reads, with zeros; and sync.

    The mark comes first and is synced, so that after a crash a record that is half overwritten is not taken for a
    damaged one.

    Returns:
        How many records were not erased before.

    Raises:
        Damage: the file is missing.
        OSError: the disk refuses; erase them again.
    """
    path, record = folder / segment_name(number), layout.record
    assert record.fields is not None
    start, mark_at = record.itemsize, record.fields["reserved"][1]
    try:
        file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError as error:
        raise missing(path, error) from error
    try:
        done = struct.pack("<I", ERASED)
        at = [HEADER_BYTES + offset * start for offset in offsets]
        at = [one for one in at if os.pread(file, 4, one + mark_at) != done]
        for one in at:
            write_at(file, struct.pack("<I", ERASING), one + mark_at)
        if at:
            os.fsync(file)
        for one in at:
            for name in ("descriptor", "local"):
                kind, field_at, *_ = record.fields[name]
                write_at(file, bytes(kind.itemsize), one + field_at)
        if at:
            os.fsync(file)
        for one in at:
            write_at(file, done, one + mark_at)
        if at:
            os.fsync(file)
        return len(at)
    finally:
        os.close(file)
