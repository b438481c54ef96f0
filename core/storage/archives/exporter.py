"""Exporting a map: writing its state of one moment as one file.

The map is read in one transaction, which does not hold up writes.  It is read twice: first the lines, for the sizes of
all parts, from which it follows how long the file will be and where each part lies; then everything, to write it.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from core.disk.files import Damage
from core.errors import StorageFailure, UnknownMap
from core.storage.archives.lines import StoredLine, camera_lines, place_lines, sequence_lines
from core.storage.archives.manifest import (
    CAMERAS,
    FORMAT,
    MANIFEST,
    MOST_MANIFEST_BYTES,
    SEAL,
    SEQUENCES,
    VERSION,
    ArchivedRecord,
    Manifest,
    Part,
    group_names,
    seal_of,
    tag_of,
    written,
)
from core.storage.archives.tar_layout import BLOCK, END_BYTES, TarLayout, header, padded
from core.storage.cameras import Access
from core.storage.database import keypoints, ledger, row_checksums
from core.storage.database.connections import FILE
from core.storage.files.row_reader import RowReader
from core.storage.files.segment_files import Layout
from core.storage.opening import OpenMap, read_layout

PLACES_PER_GROUP = 1024
BYTES_PER_GROUP = 256 << 20
"""A group is also full when it has so many bytes of pictures or of descriptors."""

CHUNK_BYTES = 1 << 20
"""Bytes of descriptors that are read and written at a time."""

Advance = Callable[[int], None]
"""Is called with the number of places that were written; what it raises ends the work."""

Expect = Callable[[int], None]
"""Is called with the size of the file in bytes before it is made; what it raises ends the work."""


@dataclass(frozen=True)
class Exported:
    """An export file.

    tag: the SHA-256 of its manifest, which identifies all bytes of the file.
    size: in bytes.
    """

    path: Path
    manifest: Manifest
    tag: str
    size: int


class Exporter:
    """Writes export files of one map.  Any thread may use it.

    Args:
        folder: of the map.
        reading: opens a connection to its database.
        opened: returns the open map, or None.
        guarded: turns errors of the disk in its block into ours, and quarantines the map if it is damaged.
    """

    def __init__(
        self,
        folder: Path,
        reading: Access[sqlite3.Connection],
        opened: Callable[[], OpenMap | None],
        guarded: Callable[[str], AbstractContextManager[None]],
    ) -> None:
        self._folder, self._reading, self._opened, self._guarded = folder, reading, opened, guarded

    def state(self) -> object | None:
        """An object that is the same as long as nothing is written to the map; None while the map is not open."""
        opened = self._opened()
        return None if opened is None else opened.database.state

    def write(
        self, path: Path, advance: Advance = lambda _written: None, expect: Expect = lambda _size: None
    ) -> Exported:
        """Write the present state of the map as a new file, which a crash may lose; nothing is left if this raises.

        Every row of the database and every descriptor is compared with its checksum.

        Raises:
            UnknownMap, MapQuarantined: the map was deleted meanwhile, or is damaged.
            StorageFull, StorageFailure.
        """
        # Deleting the map waits for its readers, so this ends as soon as the map is closed.
        with self._guarded("export"), self._reading() as connection, self._files_kept():
            connection.execute("BEGIN")
            try:
                record, layout = read_layout(connection)
                for table in ("places", "cameras"):
                    if broken := row_checksums.mismatched(connection, table):
                        raise Damage(f"{FILE}: {broken[0]!r} of {table} does not match its checksum")
                manifest = self._planned(connection, ArchivedRecord.model_validate(record.model_dump()), layout)
                tape = TarLayout(manifest, len(written(manifest)))
                expect(tape.size)
                file = path.open("xb")
                try:
                    with file:
                        return self._write(file, path, connection, manifest, tape, layout, advance)
                except BaseException:
                    path.unlink(missing_ok=True)
                    raise
            finally:
                if connection.in_transaction:  # SQLite may have ended it itself; that error is the one to report
                    connection.execute("ROLLBACK")

    def _planned(self, connection: sqlite3.Connection, record: ArchivedRecord, layout: Layout) -> Manifest:
        """The manifest of the file with the sizes of all parts, without their SHA-256.

        Raises:
            StorageFailure: it would be too long for an import.
        """
        parts = []
        for name, lines in ((SEQUENCES, sequence_lines(connection)), (CAMERAS, camera_lines(connection))):
            sizes = [len(line) for line in lines]
            parts.append(_unread(name, len(sizes), sum(sizes)))
        places = 0
        for group in self._grouped(connection, layout):
            rows, text, pictures, records = group
            sizes = [text, rows * layout.frame.itemsize, pictures, records]
            names = group_names((len(parts) - 2) // len(sizes))
            parts += [_unread(name, rows, size) for name, size in zip(names, sizes, strict=True)]
            places += rows
        manifest = Manifest(format=FORMAT, version=VERSION, map=record, places=places, parts=parts)
        if len(written(manifest)) > MOST_MANIFEST_BYTES:
            more = f"{len(parts)} parts, which no import takes"
            raise StorageFailure(f"The map has too many places for one file: {more}.")
        return manifest

    def _grouped(self, connection: sqlite3.Connection, layout: Layout) -> Iterator[tuple[int, int, int, int]]:
        """Of each group its places, and the bytes of its lines, pictures and keypoints."""
        most = max(1, min(PLACES_PER_GROUP, BYTES_PER_GROUP // layout.frame.itemsize))
        rows = text = pictures = records = 0
        for line in place_lines(connection):
            if rows == most or (rows and pictures + line.picture_bytes > BYTES_PER_GROUP):
                yield rows, text, pictures, records
                self._expect_there()
                rows = text = pictures = records = 0
            rows, text = rows + 1, text + len(line.text)
            pictures, records = pictures + line.picture_bytes, records + line.keypoints_bytes
        if rows:
            yield rows, text, pictures, records

    def _write(
        self,
        file: BinaryIO,
        path: Path,
        connection: sqlite3.Connection,
        planned: Manifest,
        tape: TarLayout,
        layout: Layout,
        advance: Advance,
    ) -> Exported:
        file.seek(tape.members[2].start - BLOCK)  # the manifest comes last, when it is known
        sequences, cameras = planned.parts[:2]
        parts = [
            _write_part(file, sequences, sequence_lines(connection)),
            _write_part(file, cameras, camera_lines(connection)),
        ]
        lines, done = place_lines(connection), 0
        for number in range(planned.groups):
            places, frames, pictures, records = planned.group(number)
            group = list(islice(lines, places.rows))
            parts += [
                _write_part(file, places, (line.text for line in group)),
                _write_part(file, frames, self._frames(group, layout)),
                _write_part(file, pictures, _pictures(connection, group)),
                _write_part(file, records, _keypoints(connection, group)),
            ]
            done += len(group)
            advance(done)
        file.write(bytes(END_BYTES))
        manifest = planned.model_copy(update={"parts": parts})
        text = written(manifest)
        file.seek(0)
        for name, data in ((MANIFEST, text), (SEAL, seal_of(text))):
            file.write(header(name, len(data)) + data.ljust(padded(len(data)), b"\0"))
        return Exported(path, manifest, tag_of(text), tape.size)

    def _frames(self, group: list[StoredLine], layout: Layout) -> Iterator[memoryview]:
        """The descriptors of places as they are stored (:attr:`Layout.frame`), in their order."""
        reader, step = RowReader(self._folder, layout), max(1, CHUNK_BYTES // layout.record.itemsize)
        for first in range(0, len(group), step):
            some = group[first : first + step]
            rows = np.array([line.row for line in some], np.int64)
            checksums = np.array([line.checksum for line in some], np.uint32)
            yield reader.frames(rows, checksums).view(np.uint8).data
            self._expect_there()

    def _files_kept(self) -> AbstractContextManager[None]:
        """No segment file is deleted during the block."""
        opened = self._opened()
        return nullcontext() if opened is None else opened.removed_segments.kept()

    def _expect_there(self) -> None:
        if self._opened() is None:
            raise UnknownMap(f"The map {self._folder.name!r} was deleted or closed while it was read.")


def _unread(name: str, rows: int, size: int) -> Part:
    return Part(name=name, rows=rows, bytes=size, sha256="0" * 64)


def _pictures(connection: sqlite3.Connection, group: Iterable[StoredLine]) -> Iterator[bytes]:
    for line in group:
        if line.picture_bytes:
            content = ledger.picture(connection, line.number, line.id)
            assert content is not None
            yield content


def _keypoints(connection: sqlite3.Connection, group: Iterable[StoredLine]) -> Iterator[bytes]:
    for line in group:
        if line.keypoints_bytes:
            yield keypoints.record_of(connection, line.number)


def _write_part(file: BinaryIO, part: Part, chunks: Iterable[bytes | memoryview]) -> Part:
    """Write a part with its header; return it with its SHA-256."""
    file.write(header(part.name, part.bytes))
    digest, size = hashlib.sha256(), 0
    for chunk in chunks:
        file.write(chunk)
        digest.update(chunk)
        size += len(chunk)
    assert size == part.bytes, f"{part.name} has another size than a moment before, in one transaction"
    file.write(bytes(padded(size) - size))
    return part.model_copy(update={"sha256": digest.hexdigest()})
