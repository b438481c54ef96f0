"""Exporting a map: its state of one moment as one file.

The map is read in one transaction, which does not hold up writes.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import numpy as np

from core.disk.files import Damage
from core.errors import UnknownMap
from core.maps.archives.manifest import ArchivedRecord
from core.maps.archives.writing import Advance, ArchivedPlace, Expect, Exported, write_archive
from core.storage.archives.stored_lines import camera_lines, place_lines, sequence_lines
from core.storage.cameras import Access
from core.storage.database import keypoints, ledger, row_checksums
from core.storage.database.connections import FILE
from core.storage.files.row_reader import RowReader
from core.storage.files.segment_files import Layout
from core.storage.opening import OpenMap, read_layout

CHUNK_BYTES = 1 << 20
"""Bytes of descriptors that are read and written at a time."""


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
        with self._guarded("export"), self._reading() as connection, self._files_retained():
            connection.execute("BEGIN")
            try:
                record, layout = read_layout(connection)
                for table in ("places", "cameras"):
                    if broken := row_checksums.mismatched(connection, table):
                        raise Damage(f"{FILE}: {broken[0]!r} of {table} does not match its checksum")
                archived = ArchivedRecord.model_validate(record.model_dump())
                source = _Source(connection, archived, self._folder, layout, self._expect_there)
                return write_archive(source, path, advance, expect)
            finally:
                if connection.in_transaction:  # SQLite may have ended it itself; that error is the one to report
                    connection.execute("ROLLBACK")

    def _files_retained(self) -> AbstractContextManager[None]:
        """No segment file is deleted during the block."""
        opened = self._opened()
        return nullcontext() if opened is None else opened.removed_segments.retained()

    def _expect_there(self) -> None:
        if self._opened() is None:
            raise UnknownMap(f"The map {self._folder.name!r} was deleted or closed while it was read.")


class _Source:
    """A map as it is in one transaction (:class:`core.maps.archives.writing.ArchiveSource`)."""

    def __init__(
        self,
        connection: sqlite3.Connection,
        record: ArchivedRecord,
        folder: Path,
        layout: Layout,
        expect_there: Callable[[], None],
    ) -> None:
        self.record, self.frame_bytes, self.expect_there = record, layout.frame.itemsize, expect_there
        self._connection, self._folder, self._layout = connection, folder, layout

    def sequence_lines(self) -> Iterator[bytes]:
        return sequence_lines(self._connection)

    def camera_lines(self) -> Iterator[bytes]:
        return camera_lines(self._connection)

    def places(self) -> Iterator[ArchivedPlace]:
        return place_lines(self._connection)

    def frames(self, group: Sequence[ArchivedPlace]) -> Iterator[memoryview]:
        reader, step = RowReader(self._folder, self._layout), max(1, CHUNK_BYTES // self._layout.record.itemsize)
        for first in range(0, len(group), step):
            some = group[first : first + step]
            rows = np.array([place.row for place in some], np.int64)
            checksums = np.array([place.checksum for place in some], np.uint32)
            yield reader.frames(rows, checksums).view(np.uint8).data
            self.expect_there()

    def pictures(self, group: Sequence[ArchivedPlace]) -> Iterator[bytes]:
        for place in group:
            if place.picture_bytes:
                content = ledger.picture(self._connection, place.number, place.id)
                assert content is not None
                yield content

    def keypoints(self, group: Sequence[ArchivedPlace]) -> Iterator[bytes]:
        for place in group:
            if place.keypoints_bytes:
                yield keypoints.record_of(self._connection, place.number)
