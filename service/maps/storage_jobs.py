"""Jobs on what a map stores: one rebuilds its search index, one compares all of it with its checksums."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from core.errors import MapQuarantined
from service.engine.engine import Engine
from service.jobs.context import JobContext, creation_time, yield_to_requests

REBUILD, VERIFY = "rebuild", "verify"


def rebuild(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Rebuild a map's search index; after a restart the job begins again.

    Raises:
        UnknownMap, MapQuarantined, StorageFull, StorageFailure: the codes that were stored until then stay.
        JobCancelled, JobInterrupted.
    """
    status = context.map(engine.maps).rebuild_index(_progress_callback(engine, context))
    return {"index": status.model_dump(mode="json")}


def verify(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Read all of a map, damaged or not, and compare it with its checksums; a restart begins again.

    Raises:
        UnknownMap, StorageFailure.
        JobCancelled, JobInterrupted.
    """
    with suppress(MapQuarantined):  # a damaged map can be verified, too
        context.map(engine.maps)
    return engine.maps.verify(str(context.map_id), _progress_callback(engine, context)).model_dump(mode="json")


def creation_times(engine: Engine, map_id: str) -> dict[str, str]:
    """The creation time of a map by its id, for a job that must not run on a later map; empty if the map is damaged.

    Raises:
        UnknownMap, StorageFailure.
    """
    try:
        return {map_id: creation_time(engine.maps.find(map_id))}
    except MapQuarantined:
        return {}


def _progress_callback(engine: Engine, context: JobContext) -> Callable[[int, int], None]:
    """Report progress, and let requests that wait for the encoder go first."""

    def advance(done: int, total: int) -> None:
        context.progress(done, total)
        yield_to_requests(engine, context)

    return advance
