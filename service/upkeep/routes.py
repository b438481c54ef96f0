"""Routes that re-encode, rebuild, examine, align, prune and merge maps."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Depends, Query, Response
from pydantic import Field

from core import errors
from core.places import check_map_id
from core.store import Map
from service.engine.engine import Engine
from service.errors.faults import (
    EncoderNotInstalled,
    ImagesMissing,
    InvalidRequest,
    JobQueueFull,
    MergeConflict,
    TooFewFrames,
    TooManyMaps,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.http.routing import EngineDep, FromState, MapId, PrincipalDep, StrictRoute, json_body, single_values
from service.http.schemas import Parameters
from service.jobs.context import creation_time
from service.jobs.jobs import Jobs
from service.jobs.routes import JobsDep, location_of
from service.jobs.schemas import JobView
from service.maps import storage_jobs
from service.maps.calibration_preview import calibration_doubt
from service.maps.limits import check_new_map
from service.queries.answers import StatisticsDep
from service.queries.counts import Statistics
from service.queries.statistics import QueryStatistics, map_key
from service.upkeep import alignment, erasure, keypoints, merging, pruning, reencoding
from service.upkeep.health import examine_health
from service.upkeep.schemas import Aligning, Erasing, MapHealth, Merging, Pruning, Reencoding, TrendsView
from service.upkeep.trends import trends_of, trends_view
from service.worker_threads import in_thread

router = APIRouter(
    prefix="/v1/maps/{map}",
    tags=["upkeep"],
    route_class=StrictRoute,
    dependencies=[Depends(single_values)],
)
JOB_PROBLEMS = (UnsupportedMediaType, JobQueueFull, errors.StorageFull)


class HealthParameters(Parameters):
    """How thorough and how long a health report is."""

    seconds: float = Field(
        default=5.0,
        gt=0,
        le=20,
        allow_inf_nan=False,
        description="Seconds for examining the map's frames; of a large map only a part is examined in that time.",
    )
    limit: int = Field(
        default=20, ge=1, le=1000, description="How many places, gaps and stretches are listed at most, each."
    )


def submit(
    engine: Engine, jobs: Jobs, response: Response, kind: str, arguments: dict[str, Any], map_: Map, *others: Map
) -> JobView:
    """Submit a job of a registered kind on a map; the job fails if a later map has taken the place of one of the maps.

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
    responses=problem_documentation(*JOB_PROBLEMS, errors.MapExists, TooManyMaps, errors.UnknownEncoder, ImagesMissing),
)
def reencode_map(
    map_id: MapId, options: Reencoding, engine: EngineDep, jobs: JobsDep, principal: PrincipalDep, response: Response
) -> JobView:
    """Make a new map from the images of this map, for another encoder or with the cameras' present masks.

    The map must keep the images of all its places. It serves meanwhile, and changes to it are copied, too. The new
    map is listed only when it is complete.
    """
    check_map_id(options.to)
    principal.require(options.to)
    map_ = engine.maps.get(map_id)
    identity = engine.resolve(options.encoder)
    reencoding.check_images(map_)
    check_new_map(engine, jobs, options.to)
    return submit(engine, jobs, response, reencoding.KIND, {"to": options.to, "encoder": identity}, map_)


@router.post("/rebuild", status_code=202, responses=problem_documentation(JobQueueFull, errors.StorageFull))
def rebuild_map(map_id: MapId, engine: EngineDep, jobs: JobsDep, response: Response) -> JobView:
    """Rebuild the search index of a map, its codes, from the checksummed descriptors, and measure its recall.

    Searches go on meanwhile. This is useful if the index is in doubt. A map that is searched exactly has no recall to
    measure.
    """
    return submit(engine, jobs, response, storage_jobs.REBUILD, {}, engine.maps.get(map_id))


@router.post(
    "/erase", status_code=202, dependencies=[Depends(json_body)], responses=problem_documentation(*JOB_PROBLEMS)
)
def erase_frames(map_id: MapId, order: Erasing, engine: EngineDep, jobs: JobsDep, response: Response) -> JobView:
    """Erase frames for good: places, what was stored of them, and what they have left.

    The job deletes the places and looks, the frames for review and the latest answers that are about them, with
    their pictures, descriptors, keypoints and codes, and rewrites the map's file, so that it has no byte of them any
    more. It ends the session that is named, whose run teaches the map nothing. It waits for exports and checks that
    read the map; writes to the map wait for parts of it. An empty order erases what places that were deleted before
    have left. Bags that wait to be enrolled are named in the result, and removed if the order says so.
    """
    if order.filter is not None:
        order.filter.wanted()
    arguments = order.model_dump(mode="json")
    return submit(engine, jobs, response, erasure.KIND, arguments, engine.maps.get(map_id))


@router.post("/keypoints", status_code=202, responses=problem_documentation(JobQueueFull, errors.StorageFull))
def fill_keypoints(map_id: MapId, engine: EngineDep, jobs: JobsDep, response: Response) -> JobView:
    """Find the keypoints of the places that have none, such as those enrolled before the map stored keypoints.

    They are found in the pictures that the map keeps; of a place without a picture they cannot be found. Queries of
    places that have theirs are verified meanwhile. If the map's setting `verification` is false, this finds nothing.
    """
    return submit(engine, jobs, response, keypoints.KIND, {}, engine.maps.get(map_id))


@router.get("/health", responses=problem_documentation(EncoderNotInstalled))
async def check_health(
    map_id: MapId,
    options: Annotated[HealthParameters, Query()],
    engine: EngineDep,
    statistics: StatisticsDep,
    one_at_a_time: Annotated[CapacityLimiter, Depends(FromState("health_examinations"))],
) -> MapHealth:
    """Report the health of a map, and which stretches of it should be recorded again.

    The report lists places that never match, places that match too often, gaps in each sequence, how the answers
    changed from week to week, and which places get worse or have changed. Answers are counted in memory and saved from
    time to time: a crash loses the last counts.
    """
    map_ = await engine.map(map_id)
    encoder = await engine.queue.load(map_.record.encoder)
    counted, trends = await in_thread(_counted, map_, statistics, options.limit)
    doubt = await in_thread(calibration_doubt, statistics, map_)
    examine = partial(examine_health, map_, encoder, counted, trends, doubt, options.seconds, options.limit)
    return await to_thread.run_sync(examine, limiter=one_at_a_time)


def _counted(map_: Map, statistics: QueryStatistics, limit: int) -> tuple[Statistics, TrendsView]:
    """The counted answers of a map, and what they tell of its places over time."""
    key = map_key(map_)
    counted = statistics.read(key)
    found = trends_of(map_, statistics.histories(key), counted.places)
    return counted, trends_view(map_.record, found, statistics.alarms(key), limit)


@router.post(
    "/align",
    status_code=202,
    dependencies=[Depends(json_body)],
    responses=problem_documentation(*JOB_PROBLEMS, errors.UnknownSequence, TooFewFrames),
)
def align_map(map_id: MapId, options: Aligning, engine: EngineDep, jobs: JobsDep, response: Response) -> JobView:
    """Find which frames of a traverse show the places of others; from then on these are the same places.

    Several traverses of one environment without poses show every place several times, and the frames of one are
    rivals of the others', so that answers are ambiguous. Sequence matching of the stored descriptors shows which
    frames correspond; the result of the job names, for each of the other traverses, the frames paired, the stretches
    that are shared, and the poses handed over. Traverses that share nothing are reported, and nothing is stored.
    Everything is stored in one commit. With `"dry_run": true` nothing is stored.
    """
    map_ = engine.maps.get(map_id)
    alignment.check_request(map_, options.sequence, options.others)
    return submit(engine, jobs, response, alignment.KIND, options.model_dump(by_alias=True), map_)


@router.post(
    "/prune",
    status_code=202,
    dependencies=[Depends(json_body)],
    responses=problem_documentation(*JOB_PROBLEMS, errors.UnknownSequence),
)
def prune_map(map_id: MapId, options: Pruning, engine: EngineDep, jobs: JobsDep, response: Response) -> JobView:
    """Remove places whose neighbours can stand in for them; by default, only report how much recall would be lost.

    A place is removed only if a place that stays is the same place by the map's settings and looks alike. With
    `"dry_run": false` the places are removed for good, all in one commit.
    """
    map_ = engine.maps.get(map_id)
    sequences = map_.transfer.sequence_ends()
    for name in (options.sequence, options.queries):
        if name is not None and name not in sequences:
            raise errors.UnknownSequence(f"The map has no sequence {name!r}.")
    if options.queries is not None and options.queries == options.sequence:
        raise InvalidRequest(
            "queries: a sequence whose frames are the queries cannot be pruned; name another sequence."
        )
    return submit(engine, jobs, response, pruning.KIND, options.model_dump(), map_)


@router.post(
    "/merge",
    status_code=202,
    dependencies=[Depends(json_body)],
    responses=problem_documentation(*JOB_PROBLEMS, errors.WrongEncoder, MergeConflict),
)
def merge_map(
    map_id: MapId, options: Merging, engine: EngineDep, jobs: JobsDep, principal: PrincipalDep, response: Response
) -> JobView:
    """Copy the places of another map of the same encoder into this one; by default, only report what would be copied.

    The report says what would be copied, which conflicts prevent it, and how many of the other map's places this map
    recognizes. With `"dry_run": false` the places are copied with their pictures and are not encoded again. Poses are
    copied as they are, so both maps must use the same frame of reference.
    """
    if options.source == map_id:
        raise InvalidRequest("from: a map cannot be merged with itself.")
    principal.require(options.source)
    map_, other = engine.maps.get(map_id), engine.maps.get(options.source)
    merging.check_same_encoder(map_, other)
    arguments = options.model_dump(by_alias=True) | {"prefix": options.prefix or f"{options.source}-"}
    if not options.dry_run:
        plan = merging.plan_merge(map_, other, arguments, map_.transfer.outline(looks=True))
        if plan.conflicts:
            raise MergeConflict(" ".join(plan.conflicts))
    return submit(engine, jobs, response, merging.KIND, arguments, map_, other)
