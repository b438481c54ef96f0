"""Exporting a map from PostgreSQL: its state of one moment as one file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from core.disk.files import disk_errors
from core.ledger.maps.archiving import LedgerSource, pieces
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.record import MapState
from core.maps.archives.writing import Advance, ArchivedPlace, Expect, Exported, write_archive
from core.postgres import rows
from core.postgres.forms import Form
from core.postgres.review import PostgresReview

Viewing = Callable[[], AbstractContextManager[tuple[MapConnection, MapState]]]


class PostgresExporter:
    """Writes export files of one map (:class:`core.maps.store.Exporter`).

    Args:
        viewing: begins a transaction that reads the map, whose state comes with it.
        state: a value that is the same as long as nothing is written to the map.
        review: the frames of the map that are stored for review.
    """

    def __init__(self, viewing: Viewing, state: Callable[[], object], review: PostgresReview) -> None:
        self._viewing, self._state, self._review = viewing, state, review

    def state(self) -> object:
        """A value that is the same as long as nothing is written to the map, and no frame of the review labelled."""
        return self._state(), self._review.labels_state()

    def write(
        self, path: Path, advance: Advance = lambda _written: None, expect: Expect = lambda _size: None
    ) -> Exported:
        """Write the present state of the map as a new file, which a crash may lose; nothing is left if this raises.

        Raises:
            UnknownMap: the map was deleted before it was read.
            StorageFull, StorageFailure.
        """
        with disk_errors("write the map as a file"), self._viewing() as (connection, state):
            source = _Source(connection, state.record, Form(state.record).frame_bytes, self._review)
            return write_archive(source, path, advance, expect)


class _Source(LedgerSource):
    def frames(self, group: Sequence[ArchivedPlace]) -> Iterator[bytes]:
        for some in pieces(group):
            numbers = [place.row for place in some]
            found = rows.both_at(self.connection, numbers)
            yield b"".join(part for row in numbers for part in found[row])

    def expect_there(self) -> None:
        """The transaction sees the map also if it was deleted since."""
