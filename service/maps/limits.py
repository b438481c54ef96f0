"""Checks before a map is made: how many maps there may be, and whether the id is free."""

from __future__ import annotations

from core.errors import MapExists, MapQuarantined, UnknownMap
from service.engine.engine import Engine
from service.errors.faults import TooManyMaps
from service.jobs.jobs import Jobs


def check_map_count(engine: Engine) -> None:
    """Check that one more map may be made; damaged maps and maps that are being made count, too.

    Raises:
        TooManyMaps: there are as many maps as the settings allow.
    """
    most = engine.settings.max_maps
    count = len(engine.all_records()) + len(engine.maps.quarantined()) + len(engine.maps.unlisted())
    if count >= most:
        raise TooManyMaps(f"There are {count} maps, and at most {most} are allowed; delete one that is not needed.")


def check_new_map(engine: Engine, jobs: Jobs, map_id: str) -> None:
    """Check that a map of this id may be made.

    Raises:
        MapExists: there is one, or one is being made, or a job is going to make one.
        TooManyMaps: there are as many maps as the settings allow.
    """
    check_map_count(engine)
    pending = {job.arguments.get("to") for job in jobs.all() if not job.ended}
    if map_id in pending or map_id in engine.maps.unlisted():
        raise MapExists(f"A map {map_id!r} is being made.")
    try:
        engine.maps.find(map_id)
    except UnknownMap:
        return
    except MapQuarantined:
        pass
    raise MapExists(f"There is a map {map_id!r} already.")
