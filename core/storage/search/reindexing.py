"""What a map is searched by, made anew because its owner wants it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from core.disk.files import disk_errors
from core.storage.map import Map
from core.storage.search.indexing import Stopped
from core.storage.search.tiers import IndexStatus


def rebuild(map_: Map, progress: Callable[[int, int], None]) -> IndexStatus:
    """Make codes and lists anew from the checksummed descriptors; searches go on in what is there until it is done.

    A map that is searched exactly has neither: then there is nothing to make.

    Args:
        progress: told of rows done and of all; what it raises leaves everything as it was.

    Raises:
        UnknownMap, MapQuarantined, StorageFailure.
    """
    map_.open()
    if (indexer := map_.indexer) is not None:
        with disk_errors(f"read map {map_.record.id!r}"), suppress(Stopped):
            indexer.rebuild(progress)
    map_.open()  # says so if it was closed meanwhile
    return map_.index_status()
