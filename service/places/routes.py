"""Routes of places and traverses: enrol one frame or many; list, read, edit and delete places; fetch thumbnails."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from starlette.responses import Response

from core import errors
from core.maps.cameras import ReadCameras
from core.maps.records import merge_patch
from service.engine.engine import Engine, camera_mask
from service.engine.queue import RequestDeadline
from service.errors.faults import (
    BatchOutOfOrder,
    BodyTooLarge,
    EncoderNotInstalled,
    ImplausiblePose,
    InvalidRequest,
    JobQueueFull,
    MalformedBody,
    QueueFull,
    StagingFull,
    TooManyPlaces,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.http.openapi import form_body, frame_body, json_patch
from service.http.routing import (
    WHOLE_DELETION,
    DeadlineDep,
    EngineDep,
    FromState,
    MapId,
    Page,
    PlaceId,
    SequenceName,
    StrictRoute,
    frame_for_map,
    json_body,
    milliseconds_since,
    rounded,
    single_values,
    started,
)
from service.http.uploads import json_part, read_many
from service.jobs.jobs import Jobs
from service.jobs.routes import JobsDep, accepted
from service.jobs.schemas import JobView
from service.places import bulk_enrolment
from service.places.batch_order import BatchOrder, BatchTurn
from service.places.batches import check_batch, entry_id, frame_problem, read_entry
from service.places.comparison import TraverseComparison, TraverseToCompare, compare, expect_coordinates
from service.places.enrolment import FrameToEnrol, enrol
from service.places.filters import MOST_DELETED, DeletedPlaces, Deletion, PlacePageQuery
from service.places.parameters import BatchParameters, EnrolParameters, check_metadata, check_taken
from service.places.place_events import tell_change, tell_deletion, tell_enrolment
from service.places.schemas import (
    BatchResult,
    BatchResults,
    DeletedSequence,
    EnrolledPlace,
    PlaceChanges,
    PlacePage,
    PlaceView,
    SequencePage,
)
from service.places.staging import Staging
from service.worker_threads import in_thread

StagingDep = Annotated[Staging, Depends(FromState("staging"))]
BatchOrderDep = Annotated[BatchOrder, Depends(FromState("batch_order"))]

router = APIRouter(
    prefix="/v1/maps/{map}/places",
    tags=["places"],
    route_class=StrictRoute,
    dependencies=[Depends(single_values)],
)
traverses = APIRouter(
    prefix="/v1/maps/{map}/sequences",
    tags=["sequences"],
    dependencies=[Depends(single_values)],
)
ENROLMENT_PROBLEMS = (
    errors.UnknownCamera,
    errors.WrongEncoder,
    errors.MixedCoordinates,
    UnsupportedMediaType,
    errors.NoRegions,
    errors.StorageFull,
    TooManyPlaces,
    QueueFull,
    EncoderNotInstalled,
)
BATCH_BODY = form_body(
    "A JSON part `places` and the file parts that it names.",
    {
        "places": {
            "type": "array",
            "items": {"$ref": "#/components/schemas/BatchItem"},
            "examples": [[{"id": "p7", "file": "frame7", "x": 1.5, "y": 2.0}]],
        }
    },
    ["places"],
)


THUMBNAIL: dict[int | str, dict[str, Any]] = {
    200: {"description": "A small JPEG.", "content": {"image/jpeg": {"schema": {"type": "string"}}}}
}


@router.put(
    "/{place}",
    openapi_extra=frame_body(EnrolParameters),
    responses={
        201: {"model": EnrolledPlace, "description": "A new place."},
        **problem_documentation(*ENROLMENT_PROBLEMS),
    },
)
async def enrol_place(
    map_id: MapId,
    place_id: PlaceId,
    options: Annotated[EnrolParameters, Query()],
    request: Request,
    response: Response,
    engine: EngineDep,
    deadline: DeadlineDep,
) -> EnrolledPlace:
    """Enrol one frame as a place with an id that the caller chooses.

    The whole place is replaced: parameters that are left out are cleared. The same bytes are not
    encoded again, so a request can be repeated until it succeeds. The answer comes when the place is
    on disk and every later query finds it.
    """
    map_, data, options = await frame_for_map(request, engine, map_id, options)
    fields = options.place_fields(engine.settings)
    mask = await camera_mask(map_, fields.camera)
    stored = (await enrol(engine, map_, [FrameToEnrol(place_id, fields, data, mask)], deadline))[0]
    response.status_code = 201 if stored.change == "created" else 200
    request.state.noted = {"map": map_id, "change": stored.change}
    return EnrolledPlace(
        **PlaceView.of(stored.place).__dict__,
        change=stored.change,
        encoder=map_.record.encoder,
        milliseconds=rounded({**stored.milliseconds, "total": milliseconds_since(started(request))}),
    )


@router.post(
    "",
    response_model=BatchResults,
    response_model_exclude_unset=True,
    openapi_extra=BATCH_BODY,
    responses={
        202: {"model": JobView, "description": "With `background`: the job that enrols the frames."},
        **problem_documentation(*ENROLMENT_PROBLEMS, BatchOutOfOrder, ImplausiblePose, JobQueueFull, StagingFull),
    },
)
async def enrol_places(
    map_id: MapId,
    options: Annotated[BatchParameters, Query()],
    request: Request,
    engine: EngineDep,
    jobs: JobsDep,
    staging: StagingDep,
    batch_order: BatchOrderDep,
    deadline: DeadlineDep,
) -> BatchResults | Response:
    """Enrol many frames in one request; a bad frame fails alone, and all others are stored in one commit.

    With `background` the request may be as long as a traverse: it is written to disk as it arrives, and answered with
    `202` and a job once it has arrived completely. The job stores a few frames at a time, goes on after a restart of
    the service, and reports the frames that failed in its result. With `align` it then finds which of the enrolled
    frames show places that the map had already.

    To go on with a traverse that was interrupted, first send only the `sha256` of each frame: only the frames answered
    with `frame-needed` have to be sent.

    To have the next batch encoded while this one is being stored, name them: `?batch=a`, then `?batch=b&after=a`.
    """
    if options.background:
        return await _enrol_later(map_id, options, request, engine, jobs, staging)
    with batch_order.enter(map_id, options.batch, options.after, deadline) as batch_turn:
        return await _enrol_now(map_id, options, request, engine, deadline, batch_turn)


async def _enrol_now(
    map_id: str,
    options: BatchParameters,
    request: Request,
    engine: Engine,
    deadline: RequestDeadline,
    batch_turn: BatchTurn,
) -> BatchResults:
    engine.queue.check_room()
    map_ = await engine.map(map_id)
    entries, files = json_part(await read_many(request, engine.settings), "places")
    engine.assert_encoder(map_, options.encoder)
    check_batch(entries, [part.name for part in files], engine.settings.max_batch_items)
    cameras = ReadCameras(await in_thread(map_.cameras.all))
    engine.metrics.batches.labels("enrol").observe(len(entries))

    results: list[BatchResult | None] = [None] * len(entries)

    def reject(position: int, error: Exception) -> None:
        problem = frame_problem(request, error)
        results[position] = BatchResult(id=entry_id(entries[position]), status=problem.status, problem=problem)

    ids: set[str] = set()
    frames: dict[int, FrameToEnrol] = {}
    by_name = {part.name: part for part in files}
    for position, entry in enumerate(entries):
        try:
            frame = read_entry(entry, by_name, by_name.__getitem__, cameras, engine.settings)
            if frame.id in ids:
                raise InvalidRequest(f"id: the batch has {frame.id} twice.")
            ids.add(frame.id)
            frames[position] = frame
        except Exception as error:
            reject(position, error)
    positions = list(frames)
    stored = await enrol(
        engine,
        map_,
        list(frames.values()),
        deadline,
        lambda index, error: reject(positions[index], error),
        batch_turn=batch_turn,
        replace_places=options.replace,
    )
    for index, one in stored.items():
        results[positions[index]] = BatchResult(
            id=one.place.id,
            status=201 if one.change == "created" else 200,
            change=one.change,
            place=PlaceView.of(one.place),
        )
    request.state.noted = {"map": map_id, "frames": len(entries), "stored": len(stored)}
    return BatchResults(items=[result for result in results if result is not None], encoder=map_.record.encoder)


async def _enrol_later(
    map_id: str, options: BatchParameters, request: Request, engine: Engine, jobs: Jobs, staging: Staging
) -> Response:
    map_ = await engine.map(map_id)
    engine.assert_encoder(map_, options.encoder)
    job = await bulk_enrolment.receive(
        engine, jobs, staging, map_, request, options.align, options.most_speed, options.replace
    )
    request.state.noted = {"map": map_id, "frames": job.arguments["places"], "job": job.id}
    return accepted(job, engine.settings)


@router.get("", responses=problem_documentation(errors.InvalidCursor))
def list_places(map_id: MapId, page: PlacePageQuery, engine: EngineDep) -> PlacePage:
    """List places in the order of their enrolment: all, or those of a traverse, a camera, a time, or some metadata."""
    places, next_cursor = engine.maps.get(map_id).places(page.cursor, page.limit, page.wanted())
    return PlacePage(items=[PlaceView.of(place) for place in places], next_cursor=next_cursor)


@router.post(
    ":delete",
    dependencies=[Depends(json_body)],
    responses=problem_documentation(
        UnsupportedMediaType, MalformedBody, BodyTooLarge, errors.TooManyToDelete, errors.StorageFull
    ),
)
def delete_places(map_id: MapId, order: Deletion, request: Request, engine: EngineDep) -> DeletedPlaces:
    """Delete many places in one commit, by their ids or by conditions; by default, only say which these would be.

    To delete exactly the places that a dry run named, send their ids. At most 10 000 places are deleted at once.
    """
    map_, wanted = engine.maps.get(map_id), order.wanted()
    choose = map_.ids_of if order.dry_run else map_.forget_all
    found = engine.reserve.making_room(partial(choose, wanted, MOST_DELETED))
    changed = {} if found and not order.dry_run else {"change": None}
    if not order.dry_run:
        tell_change(engine, map_, "deleted", len(found))
    request.state.noted = {"map": map_id, "places": len(found), **changed}
    there = set(found)
    missing = [place_id for place_id in wanted.ids or () if place_id not in there]
    return DeletedPlaces(dry_run=order.dry_run, places=len(found), ids=found, missing=missing)


@router.post(
    ":compare",
    dependencies=[Depends(json_body)],
    responses=problem_documentation(
        UnsupportedMediaType, MalformedBody, BodyTooLarge, errors.UnknownCamera, errors.MixedCoordinates
    ),
)
def compare_places(map_id: MapId, order: TraverseToCompare, engine: EngineDep) -> TraverseComparison:
    """Compare a traverse with the places of a map before its frames are sent; nothing is stored.

    First send the ids alone; then, of the places that are `taken`, the ids with the SHA-256 of the frames' bytes: a
    traverse whose enrolment broke off is `known`, and only frames that differ stay `taken`. A map has one kind of
    coordinates, and poses of the other kind are refused.
    """
    map_ = engine.maps.get(map_id)
    expect_coordinates(map_, order.coordinates)
    mask = map_.cameras.mask(order.camera)
    frames = {one.id: None if one.sha256 is None else bytes.fromhex(one.sha256) for one in order.places}
    return compare(map_, frames, order.sequence, order.named, mask)


@router.get("/{place}", responses=problem_documentation(errors.UnknownPlace))
def read_place(map_id: MapId, place_id: PlaceId, engine: EngineDep) -> PlaceView:
    """Read one place."""
    return PlaceView.of(engine.maps.get(map_id).place(place_id))


@router.patch(
    "/{place}",
    dependencies=[Depends(json_body)],
    openapi_extra=json_patch(PlaceChanges),
    responses=problem_documentation(
        UnsupportedMediaType,
        errors.UnknownPlace,
        errors.InvalidField,
        errors.MixedCoordinates,
        errors.StorageFull,
    ),
)
def edit_place(map_id: MapId, place_id: PlaceId, changes: PlaceChanges, engine: EngineDep) -> PlaceView:
    """Edit the fields of a place by a merge patch: `null` clears a field, and fields that are left out stay."""
    check_taken(changes.timestamp)
    map_ = engine.maps.get(map_id)
    with engine.writing(map_id):
        if changes.metadata is not None:
            check_metadata(merge_patch(map_.place(place_id).metadata, changes.metadata), engine.settings)
        place = map_.patch(place_id, changes.model_dump(exclude_unset=True))
    tell_enrolment(engine, map_, [(place, "updated")])
    return PlaceView.of(place)


@router.delete(
    "/{place}",
    status_code=204,
    dependencies=[WHOLE_DELETION],
    responses=problem_documentation(errors.UnknownPlace, errors.StorageFull),
)
def delete_place(map_id: MapId, place_id: PlaceId, engine: EngineDep) -> None:
    """Delete a place: no later query finds it."""
    map_ = engine.maps.get(map_id)
    engine.reserve.making_room(partial(map_.forget, place_id))
    tell_deletion(engine, map_, place_id)


@router.get(
    "/{place}/thumbnail",
    response_class=Response,
    responses={**THUMBNAIL, **problem_documentation(errors.UnknownPlace, errors.NoThumbnail)},
)
def see_thumbnail(map_id: MapId, place_id: PlaceId, engine: EngineDep) -> Response:
    """The thumbnail of a place, or a thumbnail of the image that the map keeps."""
    picture = engine.maps.get(map_id).thumbnail(place_id)
    return Response(picture, media_type="image/jpeg", headers={"Cache-Control": "no-cache"})


@traverses.get("", responses=problem_documentation(errors.InvalidCursor))
def list_sequences(map_id: MapId, page: Page, engine: EngineDep) -> SequencePage:
    """List the traverses of a map in the order of their names."""
    summaries, next_cursor = engine.maps.get(map_id).sequences(page.cursor, page.limit)
    return SequencePage(items=summaries, next_cursor=next_cursor)


@traverses.delete("/{sequence}", dependencies=[WHOLE_DELETION], responses=problem_documentation(errors.UnknownSequence))
def delete_sequence(map_id: MapId, sequence: SequenceName, request: Request, engine: EngineDep) -> DeletedSequence:
    """Delete all places of a traverse at once."""
    map_ = engine.maps.get(map_id)
    count = engine.reserve.making_room(partial(map_.forget_sequence, sequence))
    tell_change(engine, map_, "deleted", count, sequence)
    request.state.noted = {"places": count}
    return DeletedSequence(name=sequence, places=count)
