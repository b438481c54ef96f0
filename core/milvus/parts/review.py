"""Frames that a map keeps to be reviewed, in PostgreSQL."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from psycopg import Connection

from core.errors import StorageFailure, UnknownFrame
from core.maps.records import ReviewSetting
from core.maps.review import ReviewFrame, StoredReviews, frames_to_drop
from core.milvus import ledger
from core.milvus.database import Database
from core.milvus.parts.cameras import Access
from core.milvus.pictures.stored import new_object, read_pictures

if TYPE_CHECKING:
    from core.milvus.pictures.objects import Objects

_COLUMNS = "number, at, digest, size, answer, label"


class MilvusReview:
    """The frames of one map stored for review (:class:`core.maps.review.Review`).

    They are not part of what a search needs, so writing them does not wait for other writes to the map.

    Args:
        map_number: of the map.
        reading: begins a transaction that reads the map, and raises if the map is gone.
        database: in which they are.
        objects: where new pictures are put; None: in PostgreSQL.
    """

    def __init__(self, map_number: int, reading: Access, database: Database, objects: Objects | None) -> None:
        self._map, self._reading, self._database, self._objects = map_number, reading, database, objects
        self._held: set[int] = set()

    @contextmanager
    def _writing(self) -> Iterator[Connection[Any]]:
        with self._reading():  # raises if the map is gone
            pass
        with self._database.transaction("keep a frame for review") as connection:
            yield connection

    def keep(self, data: bytes, answer: Mapping[str, Any], setting: ReviewSetting) -> bool:
        if len(data) > setting.most_bytes:
            return False
        digest = hashlib.sha256(data).digest()
        with self._writing() as connection:
            # Before a number is drawn, so that a sweep, which takes each map's lock, knows when the write has ended.
            connection.execute("SELECT 1 FROM maps WHERE number = %s FOR KEY SHARE", (self._map,))
            folder, number = ledger.new_object_key(connection)
            made = None if self._objects is None else new_object(folder, number, data)
            query = (
                "INSERT INTO review_frames (map, number, at, digest, size, answer, object)"
                " SELECT %s, %s, %s, %s, %s, %s, %s"
                " WHERE EXISTS (SELECT 1 FROM maps WHERE number = %s) ON CONFLICT DO NOTHING"
            )
            at, text = datetime.now(UTC), json.dumps(answer)
            values = (self._map, number, at, digest, len(data), text, None if made is None else made.name, self._map)
            if not connection.execute(query, values).rowcount:
                return False
            if self._objects is None or made is None:
                connection.execute("INSERT INTO review_pictures VALUES (%s, %s, %s)", (self._map, number, data))
            else:
                self._objects.put({made.name: data})
            self._drop_oldest(connection, setting)
        return True

    def shrink(self, setting: ReviewSetting) -> None:
        with self._writing() as connection:
            self._drop_oldest(connection, setting)

    def _drop_oldest(self, connection: Connection[Any], setting: ReviewSetting) -> None:
        """Drop frames, those without a label first and the oldest of these first, until the limits hold."""
        count, size = self._size(connection)
        if setting.allows(count, size):
            return
        query = "SELECT number, size FROM review_frames WHERE map = %s ORDER BY label IS NOT NULL, number"
        going = frames_to_drop(connection.execute(query, (self._map,)), count, size, setting, self._held)
        connection.execute("DELETE FROM review_frames WHERE map = %s AND number = ANY(%s)", (self._map, going))

    def page(self, before: int | None, limit: int, labelled: bool | None = None) -> StoredReviews:
        also = "" if labelled is None else f" AND label IS {'NOT ' * labelled}NULL"
        query = (
            f"SELECT {_COLUMNS} FROM review_frames WHERE map = %s AND number < %s{also} ORDER BY number DESC LIMIT %s"
        )
        with self._reading() as connection:
            found = connection.execute(query, (self._map, 2**62 if before is None else before, limit)).fetchall()
            return StoredReviews([_frame(values) for values in found], *self._size(connection))

    def labelled(self) -> list[ReviewFrame]:
        query = f"SELECT {_COLUMNS} FROM review_frames WHERE map = %s AND label IS NOT NULL ORDER BY number"
        with self._reading() as connection:
            return [_frame(values) for values in connection.execute(query, (self._map,))]

    def _size(self, connection: Connection[Any]) -> tuple[int, int]:
        """How many frames are stored, and their bytes."""
        query = "SELECT count(*), coalesce(sum(size), 0) FROM review_frames WHERE map = %s"
        ((count, size),) = connection.execute(query, (self._map,)).fetchall()
        return int(count), int(size)

    def find(self, number: int) -> ReviewFrame:
        with self._reading() as connection:
            return self._expect(connection, number)

    def picture(self, number: int) -> bytes:
        with self._reading() as connection:
            frame = self._expect(connection, number)
            query = (
                "SELECT p.bytes, f.object FROM review_frames f LEFT JOIN review_pictures p USING (map, number)"
                " WHERE f.map = %s AND f.number = %s"
            )
            ((near, name),) = connection.execute(query, (self._map, number)).fetchall()
        stored = ledger.stored_picture(near, name, frame.size, frame.digest)
        data = read_pictures(self._objects, {number: stored}).get(number)
        if data is None or hashlib.sha256(data).digest() != frame.digest:
            raise StorageFailure(f"The picture of the frame {number} is damaged; discard the frame.")
        return data

    @contextmanager
    def held(self, number: int) -> Iterator[None]:
        """Have this service not drop a frame for newer ones until the block ends; another service may."""
        self._held.add(number)
        try:
            yield
        finally:
            self._held.discard(number)

    def label(self, number: int, label: Mapping[str, Any]) -> ReviewFrame:
        with self._writing() as connection:
            frame = self._expect(connection, number)
            query = "UPDATE review_frames SET label = %s WHERE map = %s AND number = %s"
            if not connection.execute(query, (json.dumps(label), self._map, number)).rowcount:
                raise _unknown(number)
        return replace(frame, label=label)

    def discard(self, number: int) -> None:
        with self._writing() as connection:
            query = "DELETE FROM review_frames WHERE map = %s AND number = %s"
            if not connection.execute(query, (self._map, number)).rowcount:
                raise _unknown(number)

    def _expect(self, connection: Connection[Any], number: int) -> ReviewFrame:
        query = f"SELECT {_COLUMNS} FROM review_frames WHERE map = %s AND number = %s"
        values = connection.execute(query, (self._map, number)).fetchone()
        if values is None:
            raise _unknown(number)
        return _frame(values)


def _unknown(number: int) -> UnknownFrame:
    return UnknownFrame(f"The map keeps no frame {number} for review.")


def _frame(values: tuple[Any, ...]) -> ReviewFrame:
    number, at, digest, size, answer, label = values
    said = None if label is None else json.loads(label)
    return ReviewFrame(number, at.astimezone(UTC), digest, size, json.loads(answer), said)
