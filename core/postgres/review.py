"""Frames that a map keeps to be reviewed, in PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

from core.ledger.maps.connection import MapConnection, Reading
from core.ledger.maps.review import ReviewTable
from core.ledger.postgres import PostgresLedger
from core.postgres import rows


class PostgresReview(ReviewTable):
    """The frames of one map stored for review.

    They are not part of what a search needs, so writing them does not wait for other writes to the map.

    Args:
        map_number: of the map.
        reading: begins a transaction that reads the map, and raises if the map is gone.
        database: in which they are.
    """

    def __init__(self, map_number: int, reading: Reading, database: PostgresLedger) -> None:
        super().__init__()
        self._map, self._begin_reading, self._database = map_number, reading, database

    def _reading(self) -> AbstractContextManager[MapConnection]:
        return self._begin_reading()

    @contextmanager
    def _writing(self) -> Iterator[MapConnection]:
        with self._database.transaction("keep a frame for review") as connection:
            found = MapConnection(connection, self._map)
            rows.share(found)
            yield found
