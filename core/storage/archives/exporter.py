"""Exporting a map: its state of one moment as one file.

The map is read in one transaction, which does not hold up writes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import numpy as np

from core.disk.files import Damage
from core.errors import UnknownMap
from core.ledger.maps import cameras, places
from core.ledger.maps.archiving import LedgerSource, pieces
from core.ledger.maps.connection import MapConnection, Reading
from core.ledger.maps.review import ReviewTable
from core.maps.archives.writing import Advance, ArchivedPlace, Expect, Exported, write_archive
from core.maps.records import MapRecord
from core.storage.database.connections import FILE, read_now
from core.storage.files.row_reader import RowReader
from core.storage.files.segment_files import Layout
from core.storage.opening import OpenMap, read_layout

CHUNK_BYTES = 1 << 20
"""Bytes of descriptors that are read and written at a time."""


class Exporter:
    """Writes export files of one map.  Any thread may use it.

    Args:
        folder: of the map.
        reading: begins a transaction that reads it.
        opened: returns the open map, or None.
        guarded: turns errors of the disk in its block into ours, and quarantines the map if it is damaged.
        review: the frames of the map that are stored for review.
    """

    def __init__(
        self,
        folder: Path,
        reading: Reading,
        opened: Callable[[], OpenMap | None],
        guarded: Callable[[str], AbstractContextManager[None]],
        review: ReviewTable,
    ) -> None:
        self._folder, self._reading, self._opened, self._guarded = folder, reading, opened, guarded
        self._review = review

    def state(self) -> object | None:
        """An object that is the same as long as nothing is written to the map; None while the map is not open."""
        opened = self._opened()
        return None if opened is None else (opened.database.state, self._review.labels_state())

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
            read_now(connection)
            state, layout = read_layout(connection, self._folder.name)
            for table, names in (("places", places.unsound(connection)), ("cameras", cameras.unsound(connection))):
                if names:
                    raise Damage(f"{FILE}: {names[0]!r} of {table} does not match its checksum")
            source = _Source(connection, state.record, self._folder, layout, self._review, self._expect_there)
            return write_archive(source, path, advance, expect)

    def _files_retained(self) -> AbstractContextManager[None]:
        """No segment file is deleted during the block."""
        opened = self._opened()
        return nullcontext() if opened is None else opened.removed_segments.retained()

    def _expect_there(self) -> None:
        if self._opened() is None:
            raise UnknownMap(f"The map {self._folder.name!r} was deleted or closed while it was read.")


class _Source(LedgerSource):
    def __init__(
        self,
        connection: MapConnection,
        record: MapRecord,
        folder: Path,
        layout: Layout,
        review: ReviewTable,
        expect_there: Callable[[], None],
    ) -> None:
        super().__init__(connection, record, layout.frame.itemsize, review)
        self._expect_there, self._folder, self._layout = expect_there, folder, layout

    def expect_there(self) -> None:
        self._expect_there()

    def frames(self, group: Sequence[ArchivedPlace]) -> Iterator[memoryview]:
        reader = RowReader(self._folder, self._layout)
        for some in pieces(group, max(1, CHUNK_BYTES // self._layout.record.itemsize)):
            rows = np.array([place.row for place in some], np.int64)
            checksums = np.array([place.checksum for place in some], np.uint32)
            yield reader.frames(rows, checksums).view(np.uint8).data
            self.expect_there()
