"""What is kept of the frames of a map, as it is shown."""

from __future__ import annotations

import hashlib

from core.errors import InvalidImage, NoThumbnail, StorageFailure
from core.frames.images import Limits, decode, encode_thumbnail
from core.places import Place

LARGEST = Limits(max_bytes=1 << 30, max_pixels=1_000_000_000, min_side=1)
"""What was accepted at some time is shown whatever today's limits are; but no service can be set to accept more."""


def small_picture(place: Place, kept: tuple[bytes, bytes] | None) -> bytes:
    """A small JPEG of a place, out of what is kept of its frame and the SHA-256 of that.

    Raises:
        NoThumbnail: nothing is kept, or nothing that can be shown.
        StorageFailure: it is damaged.
        MemoryError: there is no room for its pixels.
    """
    if kept is None:
        raise NoThumbnail(f"The map keeps no picture of place {place.id!r}.")
    content, digest = kept
    if hashlib.sha256(content).digest() != digest:
        raise StorageFailure(f"The picture kept of place {place.id!r} is damaged.")
    if place.picture == "thumbnail":
        return content
    try:
        return encode_thumbnail(decode(content, LARGEST))
    except InvalidImage as error:
        raise NoThumbnail(f"The picture kept of place {place.id!r} cannot be shown: {error}") from error
