"""How many maps there may be, and whether a map of a given id can be made."""

from __future__ import annotations

from core.errors import MapExists, MapQuarantined, UnknownMap
from service.engine.engine import Engine
from service.errors.faults import TooManyMaps
from service.jobs.jobs import Jobs


def check_room(engine: Engine) -> None:
    """See that there is room for one more map; damaged maps and maps that are being made count as well.

    Raises:
        TooManyMaps: there is none.
    """
    most = engine.settings.max_maps
    count = len(engine.all_records()) + len(engine.atlas.quarantined()) + len(engine.atlas.unlisted())
    if count >= most:
        raise TooManyMaps(f"There are {count} maps of at most {most}; delete one that is not needed.")


def check_free(engine: Engine, jobs: Jobs, map_id: str) -> None:
    """See that a map of this id can be made.

    Raises:
        MapExists: there is one, or a job is to make one.
        TooManyMaps: there are as many maps as there may be.
    """
    check_room(engine)
    pending = {job.arguments.get("to") for job in jobs.all() if not job.ended}
    if map_id in pending or map_id in engine.atlas.unlisted():
        raise MapExists(f"A map {map_id!r} is being made.")
    try:
        engine.atlas.find(map_id)
    except UnknownMap:
        return
    except MapQuarantined:
        pass
    raise MapExists(f"There is a map {map_id!r} already.")
