"""The names of the objects that pictures are in."""

from __future__ import annotations

import hashlib
import secrets

from core.ledger.maps.frames import StoredObject


def new_object(folder: str, key: int, picture: bytes) -> StoredObject:
    """The object that a picture is going to be.

    Args:
        folder: of the objects of one PostgreSQL, so that several may share a bucket.
        key: a number that was drawn within the transaction of the row, by which a sweep knows when that has ended.
    """
    # By chance as well: a PostgreSQL that was restored to an earlier moment draws its keys a second time.
    name = f"{folder}/{key:016x}-{secrets.token_hex(8)}"
    return StoredObject(name, len(picture), hashlib.sha256(picture).digest())


def key_of(name: str) -> int:
    """The number that the name of an object was made with."""
    return int(name.rpartition("/")[2].partition("-")[0], 16)


def before_key(folder: str, key: int) -> str:
    """The objects of a folder whose names come behind this have at least the key."""
    return f"{folder}/{key:016x}"
