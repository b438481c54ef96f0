"""Upkeep of maps: making one anew for another encoder, health, pruning, merging."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Depends, Query, Response
from pydantic import Field

from core import errors
from core.places import check_map_id
from core.storage import Map
from service.engine.engine import Engine
from service.errors.faults import (
    EncoderNotInstalled,
    ImagesMissing,
    InvalidRequest,
    JobQueueFull,
    MergeConflict,
    TooManyMaps,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.http.dependencies import EngineDep, FromState, MapId, PrincipalDep, json_body, single_values
from service.http.route_classes import StrictRoute
from service.http.schemas import Parameters
from service.jobs.context import creation_time
from service.jobs.jobs import Jobs
from service.jobs.routes import JobsDep, location_of
from service.jobs.schemas import JobView
from service.maps import storage_jobs
from service.maps.limits import check_new_map
from service.queries.answers import StatisticsDep
from service.queries.statistics import map_key
from service.upkeep import merging, pruning, reencoding
from service.upkeep.health import examine_health
from service.upkeep.schemas import MapHealth, Merging, Pruning, Reencoding
from service.worker_threads import in_thread

router = APIRouter(
    prefix="/v1/maps/{map}",
    tags=["upkeep"],
    route_class=StrictRoute,
    dependencies=[Depends(single_values)],
)
ASKING_PROBLEMS = (UnsupportedMediaType, JobQueueFull, errors.StorageFull)


class HealthParameters(Parameters):
    """How thorough, and how long, a report on a map's health is."""

    seconds: float = Field(
        default=5.0,
        gt=0,
        le=20,
        allow_inf_nan=False,
        description="Seconds to look at the map's frames; of a large map only a part is looked at then.",
    )
    limit: int = Field(default=20, ge=1, le=1000, description="Most places, gaps and stretches that are named each.")


def submit(
    engine: Engine, jobs: Jobs, response: Response, kind: str, arguments: dict[str, Any], map_: Map, *others: Map
) -> JobView:
    """Ask for a job of a registered kind, on this map and none that comes under its id later.

    Raises:
        JobQueueFull, StorageFull, StorageFailure.
    """
    maps = {one.record.id: creation_time(one) for one in (map_, *others)}
    job = jobs.submit(kind, map_.record.id, arguments=arguments, maps=maps)
    response.headers["Location"] = location_of(job, engine.settings)
    return JobView.of(job)


@router.post(
    "/re-encode",
    status_code=202,
    dependencies=[Depends(json_body)],
    responses=problem_documentation(
        *ASKING_PROBLEMS, errors.MapExists, TooManyMaps, errors.UnknownEncoder, ImagesMissing
    ),
)
def reencode_map(
    map_id: MapId, wanted: Reencoding, engine: EngineDep, jobs: JobsDep, principal: PrincipalDep, response: Response
) -> JobView:
    """Make a map anew, under another id, for another encoder or for the masks as they are now.

    It has to keep the images of all its places. The old map serves meanwhile; what is changed in it
    is caught up with. The new one is listed when it is whole, never before.
    """
    check_map_id(wanted.to)
    principal.require(wanted.to)
    map_ = engine.atlas.get(map_id)
    identity = engine.resolve(wanted.encoder)
    reencoding.check_images(map_)
    check_new_map(engine, jobs, wanted.to)
    return submit(engine, jobs, response, reencoding.KIND, {"to": wanted.to, "encoder": identity}, map_)


@router.post("/rebuild", status_code=202, responses=problem_documentation(JobQueueFull, errors.StorageFull))
def rebuild_map(map_id: MapId, engine: EngineDep, jobs: JobsDep, response: Response) -> JobView:
    """Make what a map is searched by, codes and lists, anew from its checksummed descriptors.

    Searches go on in what is there until the new ones are put in their place, from one moment to the next. For a
    map whose places are not what they were when its codes were learnt, or whose caches somebody put back from a
    backup. A map that is searched exactly has nothing to be made.
    """
    return submit(engine, jobs, response, storage_jobs.REBUILD, {}, engine.atlas.get(map_id))


@router.get("/health", responses=problem_documentation(EncoderNotInstalled))
async def check_health(
    map_id: MapId,
    options: Annotated[HealthParameters, Query()],
    engine: EngineDep,
    statistics: StatisticsDep,
    one_at_a_time: Annotated[CapacityLimiter, Depends(FromState("health_examinations"))],
) -> MapHealth:
    """See how a map does, and where somebody should go again.

    Told are places that never match and places that match everything, gaps along each sequence, and how the
    answers changed from week to week. Answers are counted in memory and written down now and then: a crash
    loses the last of them.
    """
    map_ = await engine.map(map_id)
    try:
        encoder = await engine.queue.load(map_.record.encoder)
    except errors.UnknownEncoder as error:
        raise EncoderNotInstalled(str(error)) from error
    counted = await in_thread(statistics.read, map_key(map_))
    examine = partial(examine_health, map_, encoder, counted, options.seconds, options.limit)
    return await to_thread.run_sync(examine, limiter=one_at_a_time)


@router.post(
    "/prune",
    status_code=202,
    dependencies=[Depends(json_body)],
    responses=problem_documentation(*ASKING_PROBLEMS, errors.UnknownSequence),
)
def prune_map(map_id: MapId, wanted: Pruning, engine: EngineDep, jobs: JobsDep, response: Response) -> JobView:
    """Forget places that their neighbours stand in for; at first only report what that would cost in recall.

    A place goes only if a place that stays is the same place by the map's settings and looks alike. With
    `"dry_run": false` they go, all in one commit, for good.
    """
    map_ = engine.atlas.get(map_id)
    there = map_.transfer.sequence_ends()
    for name in (wanted.sequence, wanted.queries):
        if name is not None and name not in there:
            raise errors.UnknownSequence(f"The map has no sequence {name!r}.")
    if wanted.queries is not None and wanted.queries == wanted.sequence:
        raise InvalidRequest("queries: the frames that are asked for are not pruned; name another sequence.")
    return submit(engine, jobs, response, pruning.KIND, wanted.model_dump(), map_)


@router.post(
    "/merge",
    status_code=202,
    dependencies=[Depends(json_body)],
    responses=problem_documentation(*ASKING_PROBLEMS, errors.WrongEncoder, MergeConflict),
)
def merge_map(
    map_id: MapId, wanted: Merging, engine: EngineDep, jobs: JobsDep, principal: PrincipalDep, response: Response
) -> JobView:
    """Take the places of another map of the same encoder into this one; at first only report.

    The report says what would come, what stands against it, and how many of the other map's places this one
    recognizes. With `"dry_run": false` they come, with their pictures, without being encoded again; poses are
    taken as they are, so both maps have to be in one frame of reference.
    """
    if wanted.source == map_id:
        raise InvalidRequest("from: a map cannot be merged with itself.")
    principal.require(wanted.source)
    map_, other = engine.atlas.get(map_id), engine.atlas.get(wanted.source)
    merging.check_encoders(map_, other)
    arguments = wanted.model_dump(by_alias=True) | {"prefix": wanted.prefix or f"{wanted.source}-"}
    if not wanted.dry_run:
        plan = merging.planned(map_, other, arguments, map_.transfer.outline())
        if plan.conflicts:
            raise MergeConflict(" ".join(plan.conflicts))
    return submit(engine, jobs, response, merging.KIND, arguments, map_, other)
