"""The bytes of an export file, computed from any position on from a folder that keeps a moment of a map."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.disk.files import Damage, disk_errors
from core.storage.archives.manifest import MANIFEST, SEAL, Manifest, seal_of
from core.storage.archives.tar_layout import BLOCK, Member, TarLayout, header
from core.storage.files.segment_files import HEADER_BYTES, Layout, segment_name

ROWS = "rows.bin"
ROW = np.dtype([("row", "<u8"), ("checksum", "<u4")])
"""Of each place in the order of the file: the row of its descriptor, and that row's checksum in the database."""

CHUNK_BYTES = 1 << 20


@dataclass(frozen=True)
class LinkedSegments:
    """The segment files of the moment that is kept, linked into a folder."""

    folder: Path
    layout: Layout

    def chunks(self, rows: NDArray[np.void], most: int = CHUNK_BYTES) -> Iterator[NDArray[np.void]]:
        """The stored descriptors (:attr:`Layout.frame`) of rows, in their order, about ``most`` bytes at a time.

        Raises:
            Damage: a row does not match its checksum in the database.
            OSError: the disk refuses.
        """
        step = max(1, most // self.layout.record.itemsize)
        for start in range(0, len(rows), step):
            yield self._frames(rows[start : start + step])

    def _frames(self, rows: NDArray[np.void]) -> NDArray[np.void]:
        frames = np.zeros(len(rows), self.layout.frame)
        numbers = rows["row"].astype(np.int64)
        # Consecutive rows of one file are read at once.
        breaks = np.flatnonzero((np.diff(numbers) != 1) | (numbers[1:] % self.layout.rows_per_segment == 0)) + 1
        for run in np.split(np.arange(len(rows)), breaks):
            first = int(numbers[run[0]])
            records = self._records(first, len(run))
            for record, row in zip(records, rows[run], strict=True):
                if record["checksum"] != row["checksum"] or not self.layout.is_sound(record, int(row["row"])):
                    raise Damage(f"{self._name(first)}: row {int(row['row'])} does not match its checksum")
            for name in ("descriptor", "local"):
                frames[name][run] = records[name]
        return frames

    def _name(self, row: int) -> str:
        return segment_name(row // self.layout.rows_per_segment)

    def _records(self, first: int, count: int) -> NDArray[np.void]:
        offset = HEADER_BYTES + first % self.layout.rows_per_segment * self.layout.record.itemsize
        data = _read_at(self.folder / self._name(first), offset, count * self.layout.record.itemsize)
        if len(data) < count * self.layout.record.itemsize:
            raise Damage(f"{self._name(first)}: the file ends before row {first + count - 1}")
        return np.frombuffer(data, self.layout.record)


def _read_at(path: Path, offset: int, size: int) -> bytes:
    """Bytes of a file; fewer if it ends before."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        parts = []
        while size and (part := os.pread(descriptor, size, offset)):
            parts.append(part)
            offset, size = offset + len(part), size - len(part)
    finally:
        os.close(descriptor)
    return b"".join(parts)


@dataclass(frozen=True, eq=False)
class VirtualArchive:
    """An export file whose bytes are computed when they are read.  Any thread may read it.

    folder: keeps the moment of the map.
    text: the bytes of the manifest; their SHA-256 is ``tag``, which identifies all bytes of the file.
    """

    folder: Path
    manifest: Manifest
    text: bytes
    tag: str
    links: LinkedSegments

    @cached_property
    def tape(self) -> TarLayout:
        """Where each part lies in the file."""
        return TarLayout(self.manifest, len(self.text))

    @property
    def size(self) -> int:
        """The size of the file in bytes."""
        return self.tape.size

    @cached_property
    def _firsts(self) -> dict[str, int]:
        """The first place of each part of descriptors, by the part's name."""
        firsts, first = {}, 0
        for number in range(self.manifest.groups):
            part = self.manifest.group(number)[1]
            firsts[part.name], first = first, first + part.rows
        return firsts

    def read(self, start: int, most: int) -> bytes:
        """Up to ``most`` bytes of the file from ``start`` on; empty at its end.

        Raises:
            StorageFailure: the disk refuses, or a file is damaged.
        """
        with disk_errors("read an export"):
            most = min(most, self.size - start)
            parts = []
            while most > 0:
                part = self._piece(start, most)
                parts.append(part)
                start, most = start + len(part), most - len(part)
            return b"".join(parts)

    def _piece(self, position: int, most: int) -> bytes:
        """One or more bytes at a position, all of the same part."""
        member = self.tape.member_at(position)
        if member is None:
            return bytes(most)
        if position < member.start:
            head = header(member.name, member.size)
            return head[BLOCK - (member.start - position) :][:most]
        offset = position - member.start
        if offset >= member.size:
            return bytes(min(most, member.end - position))
        most = min(most, member.size - offset)
        if member.name == MANIFEST:
            return self.text[offset : offset + most]
        if member.name == SEAL:
            return seal_of(self.text)[offset : offset + most]
        if member.name in self._firsts:
            return self._descriptors(member, offset, most)
        found = _read_at(self.folder / member.name, offset, most)
        if len(found) < most:
            raise OSError(f"{member.name} of an export is shorter than it was")
        return found

    def _descriptors(self, member: Member, offset: int, most: int) -> bytes:
        width = self.links.layout.frame.itemsize
        first, last = offset // width, -(-(offset + most) // width)
        place = self._firsts[member.name] + first
        data = _read_at(self.folder / ROWS, place * ROW.itemsize, (last - first) * ROW.itemsize)
        try:
            found = b"".join(frames.tobytes() for frames in self.links.chunks(np.frombuffer(data, ROW)))
        except Damage as damage:
            raise OSError(str(damage)) from damage
        skipped = offset - first * width
        return found[skipped : skipped + most]

    def discard(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)
