"""Reading single rows of segment files, each of which is checked.

A large map has only codes in memory and reads its descriptors from here.  They are read by position and not through
memory maps: if a file is too short, that is reported as damage and does not end the process by a signal, and what the
system caches of the files does not count as memory of the process.
"""

from __future__ import annotations

import os
import zlib
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.disk.files import Damage, missing
from core.storage.files.row_formats import Local, inner_products
from core.storage.files.segment_files import (
    ERASED,
    ERASING,
    HEADER_BYTES,
    NO_LOCAL,
    Layout,
    check_header,
    segment_name,
)

Rows = NDArray[np.int64]
Checksums = NDArray[np.uint32]
"""Checksums of rows as SQLite has them; 0 for rows without a place."""


class RowReader:
    """Reads rows of one map's segment files.  Any thread may use it; callers ask only for rows that were written.

    Every method that reads may raise Damage (a file is missing or too short, or a row does not match its checksum or
    that in SQLite) and OSError (the disk refuses).

    part_rows: rows that are read and compared by one thread.
    """

    part_rows = 25

    def __init__(self, folder: Path, layout: Layout) -> None:
        """For the map in ``folder``; no file is opened yet."""
        self._folder, self._path = folder, os.path.join(folder, "")
        self._layout = layout
        record = layout.record
        assert record.fields is not None
        offsets = {name: described[1] for name, described in record.fields.items()}
        # A record holds descriptor, checksums, local descriptors: either end is read with the checksums.
        self._first = self._part(0, offsets["local"])
        self._last = self._part(offsets["row"], record.itemsize)

    def _part(self, start: int, stop: int) -> tuple[int, np.dtype[np.void]]:
        """The offset ``start`` in a record, and the type of its fields from byte ``start`` to ``stop``."""
        record = self._layout.record
        assert record.fields is not None and record.names is not None
        chosen = [name for name in record.names if start <= record.fields[name][1] < stop]
        fields = {
            "names": chosen,
            "formats": [record.fields[name][0] for name in chosen],
            "offsets": [record.fields[name][1] - start for name in chosen],
            "itemsize": stop - start,
        }
        return start, np.dtype(fields)  # type: ignore[call-overload]

    def check(self, number: int, rows: int) -> None:
        """Raise Damage unless the file of a segment is there, has its header, and is long enough for ``rows`` rows."""
        file = self._open(number)
        try:
            check_header(self._folder / segment_name(number), os.pread(file, HEADER_BYTES, 0), self._layout, number)
            found = (os.fstat(file).st_size - HEADER_BYTES) // self._layout.record.itemsize
        finally:
            os.close(file)
        if found < rows:
            raise Damage(f"{segment_name(number)}: the file ends after {found} of {rows} rows")

    def descriptors(self, rows: Rows, checksums: Checksums) -> NDArray[np.float32]:
        """The descriptors of rows: float32 [k, D]."""
        return self._layout.descriptors_of(self._first_parts(rows, checksums))

    def inner_products(self, queries: NDArray[np.float32], rows: Rows, checksums: Checksums) -> NDArray[np.float32]:
        """Inner products of queries, float32 [B, D], with the descriptors of rows: float32 [B, k]."""
        stored = self._first_parts(rows, checksums)["descriptor"]
        return inner_products(queries, stored, self._layout.precision)

    def locals(self, rows: Rows, checksums: Checksums) -> Local:
        """The local descriptors of rows: int8 [k, C, L]."""
        if self._layout.local_shape == NO_LOCAL:
            return np.empty((len(rows), *NO_LOCAL), np.int8)
        return self._layout.locals_of(self._checked(self._last, rows, checksums, "local"))

    def frames(self, rows: Rows, checksums: Checksums) -> NDArray[np.void]:
        """All that is stored of rows (:attr:`Layout.frame`); all checksums of each record are compared."""
        records = self._read(rows, 0, self._layout.record)
        for row, expected, record in zip(rows.tolist(), checksums.tolist(), records, strict=True):
            if record["checksum"] != expected or not self._layout.is_sound(record, row):
                name = segment_name(row // self._layout.rows_per_segment)
                raise Damage(f"{name}: row {row} does not match its checksum")
        frames = np.empty(len(rows), self._layout.frame)
        for name in ("descriptor", "local"):
            frames[name] = records[name]
        return frames

    def _first_parts(self, rows: Rows, checksums: Checksums) -> NDArray[np.void]:
        return self._checked(self._first, rows, checksums, "descriptor")

    def _checked(
        self, part: tuple[int, np.dtype[np.void]], rows: Rows, checksums: Checksums, name: str
    ) -> NDArray[np.void]:
        """Read a part of the records of rows and check that each is of its row, sound, and the one that SQLite has.

        Rows without a place may be erased.
        """
        found = self._read(rows, *part)
        whole = self._sound(found, rows, name)
        stated = found["checksum"].tolist()
        erased = np.isin(found["reserved"], (ERASING, ERASED)) & (checksums == 0)
        whole = [sound or gone for sound, gone in zip(whole, erased.tolist(), strict=True)]
        for row, expected, checksum, sound in zip(rows.tolist(), checksums.tolist(), stated, whole, strict=True):
            if not sound or (expected and expected != checksum):
                where = f"{segment_name(row // self._layout.rows_per_segment)}: row {row}"
                raise Damage(f"{where} {'is of another frame' if sound else 'does not match its checksum'}")
        return found

    def _sound(self, found: NDArray[np.void], rows: Rows, name: str) -> list[bool]:
        """Whether each record is of its row and matches the checksums that cover the field ``name``."""
        fields = found.dtype.fields
        assert fields is not None
        part, row, sums = (fields[field][1] for field in (name, "row", "of_descriptor"))
        size, length = found.dtype.itemsize, found.dtype[name].itemsize
        content = found.view(np.uint8).reshape(-1).data
        own, both = found[f"of_{name}"].tolist(), found["checksum"].tolist()
        sound = []
        for i, stated in enumerate((found["row"] == rows).tolist()):
            record = content[i * size : (i + 1) * size]
            its = zlib.crc32(record[row : row + 8], zlib.crc32(record[part : part + length]))
            sound.append(stated and its == own[i] and zlib.crc32(record[sums : sums + 8]) == both[i])
        return sound

    def _read(self, rows: Rows, start: int, dtype: np.dtype[Any]) -> NDArray[np.void]:
        """The fields ``dtype`` from byte ``start`` on of the records of rows, in the order of the rows."""
        layout, order = self._layout, np.argsort(rows, kind="stable").tolist()
        found = np.empty(len(rows), dtype)
        size, stride = dtype.itemsize, layout.record.itemsize
        content = found.view(np.uint8).reshape(-1).data
        places = [(position, *divmod(int(rows[position]), layout.rows_per_segment)) for position in order]
        for number, group in groupby(places, key=lambda place: place[1]):
            wanted = [(position * size, HEADER_BYTES + offset * stride + start) for position, _, offset in group]
            file = self._open(number)
            try:
                if len(wanted) > 1:
                    for _, at in wanted:  # lets the system fetch all of them at once
                        os.posix_fadvise(file, at, size, os.POSIX_FADV_WILLNEED)
                for to, at in wanted:
                    if os.preadv(file, [content[to : to + size]], at) < size:
                        row = int(rows[to // size])
                        raise Damage(f"{segment_name(number)}: the file ends before row {row}")
            finally:
                os.close(file)
        return found

    def _open(self, number: int) -> int:
        """A file descriptor of a segment, which the caller closes."""
        path = f"{self._path}{segment_name(number)}"
        try:
            return os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError as error:
            raise missing(Path(path), error) from error
