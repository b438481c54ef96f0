"""What a map is searched by, made anew as a job; the map as a whole read again as one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from core.errors import MapQuarantined
from core.storage.search.reindexing import rebuild as rebuild_index
from service.engine.engine import Engine
from service.jobs.context import creation_time, yield_to_requests
from service.jobs.jobs import JobContext

REBUILD, VERIFY = "rebuild", "verify"


def _telling(engine: Engine, context: JobContext) -> Callable[[int, int], None]:
    def told(done: int, total: int) -> None:
        context.progress(done, total)
        yield_to_requests(engine, context)

    return told


def rebuild(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Do what the job says, from the start: what was made before a restart was not put in place.

    Raises:
        UnknownMap, MapQuarantined, StorageFailure: the map is searched as before.
    """
    status = rebuild_index(context.map(engine.atlas), _telling(engine, context))
    return {"index": status.model_dump(mode="json")}


def verify(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Do what the job says, from the start.

    Raises:
        UnknownMap, StorageFailure.
    """
    with suppress(MapQuarantined):  # it can be read all the same
        context.map(engine.atlas)
    return engine.atlas.verify(str(context.map_id), _telling(engine, context)).model_dump(mode="json")


def incarnation(engine: Engine, map_id: str) -> dict[str, str]:
    """What a job for a map is bound to; nothing where the map is damaged.

    Raises:
        UnknownMap, StorageFailure.
    """
    try:
        return {map_id: creation_time(engine.atlas.find(map_id))}
    except MapQuarantined:
        return {}
