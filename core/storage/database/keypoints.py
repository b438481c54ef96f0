"""The statements that read and write the keypoints of places.

The checksum of a record covers the digest of its place's frame, so that keypoints of another frame do not match it.
"""

from __future__ import annotations

import json
import logging
import sqlite3
import zlib
from collections.abc import Sequence

from core.errors import InvalidKeypoints, StorageFailure
from core.geometry.keypoints import Keypoints, keypoints_of
from core.maps.records import PicturedPlace

log = logging.getLogger(__name__)

_FUNCTION = "keypoints_checksum"
_IS_SOUND = f"k.checksum = {_FUNCTION}(k.record, p.digest)"


def checksum_of(record: bytes, digest: bytes) -> int:
    """The checksum of a record of the keypoints of the frame with this digest."""
    return zlib.crc32(record, zlib.crc32(digest))


def register(connection: sqlite3.Connection) -> None:
    """Make the checksum available to the statements of a connection."""
    connection.create_function(_FUNCTION, 2, checksum_of, deterministic=True)


def _read(place_id: str, digest: bytes, checksum: int, record: bytes) -> Keypoints:
    """The keypoints of a record.

    Raises:
        InvalidKeypoints: it is damaged.
    """
    if not isinstance(record, bytes) or checksum != checksum_of(record, digest):
        raise InvalidKeypoints(f"The stored keypoints of place {place_id!r} do not match their checksum.")
    return keypoints_of(record)


def at_rows(connection: sqlite3.Connection, rows: Sequence[int]) -> dict[int, Keypoints]:
    """The keypoints of the places whose descriptors are in ``rows`` now; damaged ones are logged and left out."""
    query = (
        "SELECT p.row, p.id, p.digest, k.checksum, k.record FROM places p JOIN keypoints k ON k.place = p.number"
        " WHERE p.row IN (SELECT value FROM json_each(?))"
    )
    found = {}
    for row, *stored in connection.execute(query, (json.dumps(list(rows)),)):
        try:
            found[int(row)] = _read(*stored)
        except InvalidKeypoints as error:
            log.error("%s Its place is not verified until they are found again.", error)
    return found


def are_stored(connection: sqlite3.Connection, number: int) -> bool:
    """Whether a place has keypoints that are not damaged."""
    query = f"SELECT 1 FROM keypoints k JOIN places p ON p.number = k.place WHERE k.place = ? AND {_IS_SOUND}"
    return connection.execute(query, (number,)).fetchone() is not None


def record_of(connection: sqlite3.Connection, number: int) -> bytes:
    """The record of a place that has keypoints.

    Raises:
        StorageFailure: it is damaged.
    """
    query = (
        "SELECT p.id, p.digest, k.checksum, k.record FROM places p JOIN keypoints k ON k.place = p.number"
        " WHERE k.place = ?"
    )
    stored = connection.execute(query, (number,)).fetchone()
    try:
        _read(*stored)
    except InvalidKeypoints as error:
        raise StorageFailure(f"{error} Have them found again, or forget the place.") from error
    record: bytes = stored[3]
    return record


def put(connection: sqlite3.Connection, number: int, digest: bytes, record: bytes) -> None:
    """Store the record of a place whose frame has this digest, in the place of any other."""
    statement = "INSERT OR REPLACE INTO keypoints (place, checksum, record) VALUES (?, ?, ?)"
    connection.execute(statement, (number, checksum_of(record, digest), record))


def delete(connection: sqlite3.Connection, number: int) -> None:
    """Delete the keypoints of a place, if it has any."""
    connection.execute("DELETE FROM keypoints WHERE place = ?", (number,))


def frames_without(connection: sqlite3.Connection, after: int, limit: int) -> list[PicturedPlace]:
    """Up to ``limit`` places behind number ``after`` that keep a picture and no keypoints, or only damaged ones."""
    query = (
        "SELECT p.number, p.id, p.digest, p.camera, p.picture FROM places p LEFT JOIN keypoints k ON k.place = p.number"
        f" WHERE p.number > ? AND p.picture <> 'none' AND (k.place IS NULL OR NOT {_IS_SOUND})"
        " ORDER BY p.number LIMIT ?"
    )
    return [PicturedPlace(*values) for values in connection.execute(query, (after, limit)).fetchall()]


def room(connection: sqlite3.Connection) -> tuple[int, int]:
    """How many places have keypoints, and how many bytes their records have."""
    places, size = connection.execute("SELECT count(*), coalesce(sum(length(record)), 0) FROM keypoints").fetchone()
    return int(places), int(size)


def damaged(connection: sqlite3.Connection) -> list[str]:
    """The ids of the places whose keypoints are damaged; each record is read."""
    query = (
        "SELECT p.id, p.digest, k.checksum, k.record FROM keypoints k JOIN places p ON p.number = k.place"
        " ORDER BY k.place"
    )
    names = []
    for stored in connection.execute(query):
        try:
            _read(*stored)
        except InvalidKeypoints:
            names.append(str(stored[0]))
    return names
