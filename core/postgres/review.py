"""Frames that a map keeps to be reviewed, in PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING

from core.ledger.maps.connection import MapConnection, Reading
from core.ledger.maps.frames import StoredObject, StoredPicture
from core.ledger.maps.review import ReviewTable
from core.ledger.postgres import PostgresLedger
from core.postgres import rows
from core.postgres.pictures.stored import new_object

if TYPE_CHECKING:
    from core.postgres.pictures.objects import Objects


class PostgresReview(ReviewTable):
    """The frames of one map stored for review.

    They are not part of what a search needs, so writing them does not wait for other writes to the map.

    Args:
        map_number: of the map.
        reading: begins a transaction that reads the map, and raises if the map is gone.
        database: in which they are.
        objects: where new pictures are put; None: in PostgreSQL.
    """

    objects: Objects | None

    def __init__(self, map_number: int, reading: Reading, database: PostgresLedger, objects: Objects | None) -> None:
        super().__init__()
        self.objects, self._map, self._begin_reading, self._database = objects, map_number, reading, database

    def _reading(self) -> AbstractContextManager[MapConnection]:
        return self._begin_reading()

    @contextmanager
    def _writing(self) -> Iterator[MapConnection]:
        with self._database.transaction("keep a frame for review") as connection:
            found = MapConnection(connection, self._map)
            # Before a key is drawn, so that a sweep, which takes each map's lock, knows when the write has ended.
            rows.share(found)
            yield found

    def _picture_to_store(self, connection: MapConnection, picture: bytes) -> StoredPicture:
        return picture if self.objects is None else new_object(*rows.new_object_key(connection), picture)

    def _put_object(self, stored: StoredObject, picture: bytes) -> None:
        assert self.objects is not None
        self.objects.put({stored.name: picture})
