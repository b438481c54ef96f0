"""Routes of recordings: a bag is uploaded in pieces, and a job enrols its frames."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from pydantic import BaseModel, Field

from core import errors
from core.numerals import Whole
from service.errors.faults import (
    BodyTooLarge,
    JobQueueFull,
    RecordingInUse,
    RecordingOffset,
    StagingFull,
    UnknownRecording,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.http.bodies import intake_of
from service.http.openapi import BINARY
from service.http.routing import (
    WHOLE_DELETION,
    EngineDep,
    FromState,
    MapId,
    StrictRoute,
    json_body,
    single_values,
)
from service.http.uploads import media_type
from service.jobs.context import creation_time
from service.jobs.routes import JobsDep, location_of
from service.jobs.schemas import JobView
from service.recordings.enrolling import KIND, RecordingOrder
from service.recordings.uploads import Recordings
from service.worker_threads import in_thread

RecordingsDep = Annotated[Recordings, Depends(FromState("recordings"))]
RecordingName = Annotated[
    str,
    Path(
        alias="recording",
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,119}\.(mcap|bag|db3)$",
        description="A name of the caller's choice; its end says what kind of bag it is.",
        examples=["monday.mcap"],
    ),
]
OCTETS = "application/octet-stream"

router = APIRouter(
    prefix="/v1/maps/{map}/recordings/{recording}",
    tags=["places"],
    route_class=StrictRoute,
    dependencies=[Depends(single_values)],
)


class RecordingView(BaseModel):
    """The part of a recording that is here."""

    id: str
    bytes: int = Field(description="How many bytes are here; the next piece begins at this offset.")


BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "The bytes of the file from the offset on: all that are left, or some.",
        "content": {OCTETS: {"schema": BINARY}},
    }
}


@router.get("", responses=problem_documentation(errors.StorageFailure))
def read_recording(map_id: MapId, name: RecordingName, engine: EngineDep, recordings: RecordingsDep) -> RecordingView:
    """Read how much of a recording has arrived, to go on from there; nothing is 0 bytes."""
    engine.maps.get(map_id)
    return RecordingView(id=name, bytes=recordings.size(map_id, name))


@router.put(
    "",
    openapi_extra=BODY,
    responses=problem_documentation(
        BodyTooLarge,
        RecordingOffset,
        RecordingInUse,
        UnknownRecording,
        StagingFull,
        UnsupportedMediaType,
        errors.MissingExtra,
        errors.StorageFull,
        errors.StorageFailure,
    ),
)
async def upload_recording(
    map_id: MapId,
    name: RecordingName,
    request: Request,
    engine: EngineDep,
    recordings: RecordingsDep,
    offset: Annotated[Whole, Query(ge=0, le=2**53, description="Where the piece begins.")] = 0,
) -> RecordingView:
    """Upload a piece of a bag: a rosbag2 (`.mcap`, `.db3`) or a bag of ROS 1 (`.bag`), a file at a time.

    Pieces follow one another; one that breaks off leaves what has arrived of it. A bag with which nothing is done for a
    day is removed. It is for one service alone: where several share maps, all requests of a bag have to reach the same.
    """
    if (kind := media_type(request)) != OCTETS:
        raise UnsupportedMediaType(f"Send a piece of a recording as {OCTETS}, not as {kind[:80] or 'nothing'}.")
    await engine.map(map_id)
    goes_on = offset > 0 and recordings.is_from_caller(map_id, name)  # the audit trail has the first piece of many
    request.state.noted = {"map": map_id, "recording": name, "offset": offset} | ({"change": None} if goes_on else {})
    settings = engine.settings
    intake = intake_of(request)
    intake.is_piece()
    intake.pass_on(settings.max_batch_bytes, settings.bulk_timeout)
    size = await recordings.receive(map_id, name, offset, request.stream())
    try:
        await engine.map(map_id)
    except errors.UnknownMap:  # it was deleted meanwhile, and its bags are not for a later map of its name
        await in_thread(recordings.forget_map, map_id)
        raise
    return RecordingView(id=name, bytes=size)


@router.post(
    "",
    status_code=202,
    dependencies=[Depends(json_body)],
    responses=problem_documentation(
        UnknownRecording,
        RecordingInUse,
        JobQueueFull,
        UnsupportedMediaType,
        errors.UnknownCamera,
        errors.InvalidIdentifier,
        errors.MissingExtra,
        errors.StorageFull,
        errors.StorageFailure,
    ),
)
def enrol_recording(
    map_id: MapId,
    name: RecordingName,
    order: RecordingOrder,
    engine: EngineDep,
    jobs: JobsDep,
    recordings: RecordingsDep,
    request: Request,
    response: Response,
) -> JobView:
    """Enrol the frames of a bag that has arrived, by a job, as `placerec enrol` does.

    The bag is removed when the job has succeeded and no frame has failed. Otherwise, because the topics do not fit, for
    example, it stays and can be enrolled in another way. A job of which no frame became a place has failed.
    """
    map_ = engine.maps.get(map_id)
    map_.cameras.mask(order.camera)
    request.state.noted = {"map": map_id, "recording": name, "bytes": recordings.size(map_id, name)}
    arguments = {"recording": name, "order": order.model_dump(mode="json")}
    with recordings.unused(map_id, name):
        job = jobs.submit(KIND, map_id, arguments=arguments, maps={map_id: creation_time(map_)})
    response.headers["Location"] = location_of(job, engine.settings)
    return JobView.of(job)


@router.delete(
    "",
    status_code=204,
    dependencies=[WHOLE_DELETION],
    responses=problem_documentation(UnknownRecording, RecordingInUse, RecordingOffset, errors.StorageFailure),
)
async def delete_recording(map_id: MapId, name: RecordingName, engine: EngineDep, recordings: RecordingsDep) -> None:
    """Remove what has arrived of a bag."""
    await engine.map(map_id)
    await in_thread(recordings.remove, map_id, name)
