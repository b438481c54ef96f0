"""Where the picture of a row is: in PostgreSQL, or in an object store."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from core.errors import StorageFailure


@dataclass(frozen=True)
class StoredObject:
    """A picture that is in the object store, as its row names it.

    name: of the object; it was never used before.
    size: in bytes.
    digest: SHA-256 of the picture, 32 bytes.
    """

    name: str
    size: int
    digest: bytes


class Reader(Protocol):
    """A reader of objects: the bytes of each in order; None: it is missing or damaged."""

    def read(self, stored: Sequence[StoredObject]) -> Sequence[bytes | None]: ...


StoredPicture = bytes | StoredObject | None
"""A picture in its row: its bytes, or the object that has them; None: there is none."""


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


def size_of(picture: StoredPicture) -> int:
    """The bytes of a picture."""
    return 0 if picture is None else picture.size if isinstance(picture, StoredObject) else len(picture)


def digest_of(picture: bytes | StoredObject) -> bytes:
    """The SHA-256 of a picture, 32 bytes; that of an object is the one recorded when it was stored."""
    return picture.digest if isinstance(picture, StoredObject) else hashlib.sha256(picture).digest()


def read_pictures(objects: Reader | None, pictures: Mapping[int, StoredPicture]) -> dict[int, bytes | None]:
    """Pictures by row, wherever they are; those whose object is missing, or damaged, are left out.

    Raises:
        StorageFailure: one is in an object store, and none is known.
        StoreUnavailable: the object store cannot be reached, or refuses.
    """
    far = {name: one for name, one in pictures.items() if isinstance(one, StoredObject)}
    if far and objects is None:
        raise StorageFailure("The picture is in an object store, and this service is configured without one.")
    there = {name: one for name, one in pictures.items() if not isinstance(one, StoredObject)}
    found = zip(far, [] if objects is None else objects.read(list(far.values())), strict=True)
    return there | {name: picture for name, picture in found if picture is not None}
