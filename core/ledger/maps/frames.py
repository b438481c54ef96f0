"""Pictures and keypoints of frames by row: the content of a frame that is stored beside its descriptors.

The checksum of keypoints covers the digest of the frame, so that keypoints of another frame do not match it.
"""

from __future__ import annotations

import hashlib
import logging
import zlib
from collections.abc import Iterator, Mapping, Sequence

from sqlalchemy import and_, bindparam, delete, func, select

from core.errors import InvalidKeypoints, StorageFailure
from core.geometry.keypoints import Keypoints, keypoints_of
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import KEYPOINTS, PICTURES, PLACES
from core.ledger.statements import Statement, among
from core.maps.records import PicturedPlace

log = logging.getLogger(__name__)

_P, _K, _PICTURE = PLACES.c, KEYPOINTS.c, PICTURES.c
_OF_PLACES = PLACES.join(KEYPOINTS, and_(_K.map == _P.map, _K.row == _P.row))

_PUT_PICTURE = Statement(
    lambda insert: insert(PICTURES).values(
        {name: bindparam(name) for name in ("map", "row", "digest", "size", "bytes")}
    )
)
_PICTURES_AT = Statement(
    select(_PICTURE.row, _PICTURE.bytes, _PICTURE.digest).where(
        _PICTURE.map == bindparam("map"), among(_PICTURE.row, "rows")
    )
)
_PICTURE_SIZES = Statement(
    select(_PICTURE.row, _PICTURE.size, _PICTURE.digest).where(
        _PICTURE.map == bindparam("map"), among(_PICTURE.row, "rows")
    )
)
_RECORD_SIZES = Statement(
    select(_K.row, func.length(_K.record)).where(_K.map == bindparam("map"), among(_K.row, "rows"))
)
_PUT_KEYPOINTS = Statement(
    lambda insert: insert(KEYPOINTS).values({name: bindparam(name) for name in ("map", "row", "checksum", "record")})
)
_KEYPOINTS_AT = Statement(
    select(_P.row, _P.id, _P.digest, _K.checksum, _K.record)
    .select_from(_OF_PLACES)
    .where(_P.map == bindparam("map"), among(_P.row, "rows"))
)
_PICTURED = Statement(
    select(_P.number, _P.id, _P.digest, _P.camera, _P.picture, _P.row, _K.row)
    .select_from(PLACES.outerjoin(KEYPOINTS, and_(_K.map == _P.map, _K.row == _P.row)))
    .where(_P.map == bindparam("map"), _P.number > bindparam("after"), _P.picture != "none")
    .order_by(_P.number)
    .limit(bindparam("most"))
)
_ROOM = Statement(
    select(func.count(), func.coalesce(func.sum(func.length(_K.record)), 0)).where(_K.map == bindparam("map"))
)
_PICTURE_ROOM = Statement(select(func.coalesce(func.sum(_PICTURE.size), 0)).where(_PICTURE.map == bindparam("map")))
_DELETE_PICTURES = Statement(delete(PICTURES).where(_PICTURE.map == bindparam("map"), among(_PICTURE.row, "rows")))
_DELETE_KEYPOINTS = Statement(delete(KEYPOINTS).where(_K.map == bindparam("map"), among(_K.row, "rows")))


def checksum_of(record: bytes, digest: bytes) -> int:
    """The checksum of a record of the keypoints of the frame with this digest."""
    return zlib.crc32(record, zlib.crc32(digest))


# Pictures


def put_pictures(connection: MapConnection, pictures: Mapping[int, bytes]) -> None:
    """Store the pictures of frames that have none, by row."""
    connection.execute_many(
        _PUT_PICTURE,
        [
            {"row": row, "digest": hashlib.sha256(picture).digest(), "size": len(picture), "bytes": picture}
            for row, picture in pictures.items()
        ],
    )


def pictures_at(connection: MapConnection, rows: Sequence[int], damaged: set[int] | None = None) -> dict[int, bytes]:
    """The pictures of frames by row; frames without one are left out.

    Args:
        damaged: gets the rows whose bytes do not match their SHA-256; None: those raise.

    Raises:
        StorageFailure: the bytes of one do not match their SHA-256.
    """
    found: dict[int, bytes] = {}
    for row, content, digest in connection.execute(_PICTURES_AT, rows=list(rows)):
        if isinstance(content, bytes) and hashlib.sha256(content).digest() == digest:
            found[row] = content
        elif damaged is None:
            raise StorageFailure("A stored picture is damaged.")
        else:
            damaged.add(row)
    return found


def sizes_at(connection: MapConnection, rows: Sequence[int]) -> tuple[dict[int, tuple[int, bytes]], dict[int, int]]:
    """Of frames by row: the size and the SHA-256 of their pictures, and the bytes of the records of keypoints."""
    pictures = connection.execute(_PICTURE_SIZES, rows=list(rows))
    records = connection.execute(_RECORD_SIZES, rows=list(rows))
    return {row: (size, digest) for row, size, digest in pictures}, dict(records)


# Keypoints


def damaged_keypoints_at(connection: MapConnection, rows: Sequence[int]) -> set[int]:
    """Those of some rows whose keypoints do not match their checksum."""
    return {row for row, _, *stored in connection.execute(_KEYPOINTS_AT, rows=list(rows)) if not _is_sound(*stored)}


def _is_sound(digest: bytes, checksum: int, record: bytes) -> bool:
    return isinstance(record, bytes) and checksum == checksum_of(record, digest)


def _read(place_id: str, digest: bytes, checksum: int, record: bytes) -> Keypoints:
    if not _is_sound(digest, checksum, record):
        raise InvalidKeypoints(f"The stored keypoints of place {place_id!r} do not match their checksum.")
    return keypoints_of(record)


def keypoints_at(connection: MapConnection, rows: Sequence[int]) -> dict[int, Keypoints]:
    """The keypoints of the places whose frames are in ``rows`` now; damaged ones are logged and left out."""
    found = {}
    for row, *stored in connection.execute(_KEYPOINTS_AT, rows=list(rows)):
        try:
            found[int(row)] = _read(*stored)
        except InvalidKeypoints as error:
            log.error("%s Its place is not verified until they are found again.", error)
    return found


def has_keypoints(connection: MapConnection, row: int) -> bool:
    """Whether a place has keypoints that are not damaged."""
    return any(_is_sound(*stored) for _, _, *stored in connection.execute(_KEYPOINTS_AT, rows=[row]))


def records_at(connection: MapConnection, rows: Sequence[int]) -> dict[int, bytes]:
    """The records of the keypoints of places, by row.

    Raises:
        StorageFailure: one is damaged.
    """
    found = {}
    for row, *stored in connection.execute(_KEYPOINTS_AT, rows=list(rows)):
        try:
            _read(*stored)
        except InvalidKeypoints as error:
            raise StorageFailure(f"{error} Have them found again, or forget the place.") from error
        found[int(row)] = stored[3]
    return found


def put_keypoints(connection: MapConnection, records: Mapping[int, tuple[bytes, bytes]]) -> None:
    """Store records of keypoints in the place of any others: digest of the frame and record, by row."""
    connection.execute(_DELETE_KEYPOINTS, rows=list(records))
    connection.execute_many(
        _PUT_KEYPOINTS,
        [
            {"row": row, "checksum": checksum_of(record, digest), "record": record}
            for row, (digest, record) in records.items()
        ],
    )


def without_keypoints(connection: MapConnection, after: int, limit: int) -> list[PicturedPlace]:
    """Up to ``limit`` places behind number ``after`` that keep a picture and no keypoints, or only damaged ones."""
    found: list[PicturedPlace] = []
    while len(found) < limit:
        page = connection.execute(_PICTURED, after=after, most=limit)
        sound = set(_sound_rows(connection, [row for *_, row, has in page if has is not None]))
        found += [PicturedPlace(*values) for *values, row, _ in page if row not in sound]
        if len(page) < limit:
            break
        after = page[-1][0]
    return found[:limit]


def _sound_rows(connection: MapConnection, rows: Sequence[int]) -> Iterator[int]:
    if rows:
        for row, _, *stored in connection.execute(_KEYPOINTS_AT, rows=list(rows)):
            if _is_sound(*stored):
                yield int(row)


def room(connection: MapConnection) -> tuple[int, int, int]:
    """How many frames have keypoints, the bytes of their records, and the bytes of pictures."""
    ((count, size),) = connection.execute(_ROOM)
    ((pictures,),) = connection.execute(_PICTURE_ROOM)
    return int(count), int(size), int(pictures)


def delete_pictures(connection: MapConnection, rows: Sequence[int]) -> None:
    """Delete pictures of frames."""
    connection.execute(_DELETE_PICTURES, rows=list(rows))


def delete_frames(connection: MapConnection, rows: Sequence[int]) -> None:
    """Delete pictures and keypoints of frames."""
    delete_pictures(connection, rows)
    connection.execute(_DELETE_KEYPOINTS, rows=list(rows))
