"""Calibrating a map: when are its answers to be believed?"""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Depends, Request, Response

from core import errors
from core.method.encoder import Encoding
from core.storage import Map
from service.engine.engine import Engine, camera_mask
from service.engine.queue import RequestDeadline
from service.errors.faults import (
    DeadlineExceeded,
    EncoderNotInstalled,
    InvalidRequest,
    JobQueueFull,
    QueueFull,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.http.bodies import json_size, parse_json
from service.http.dependencies import DeadlineDep, EngineDep, IfMatch, MapId, single_values
from service.http.headers import expected_revision
from service.http.schemas import validated
from service.http.uploads import FORM, check_part, is_file, json_part, media_type, read_many
from service.jobs.context import creation_time
from service.jobs.routes import JobsDep, accepted
from service.jobs.schemas import JobView
from service.maps.calibration import KIND, arguments_of, measured, store
from service.maps.schemas import CalibrationOrder, CalibrationReport
from service.worker_threads import in_thread

router = APIRouter(
    prefix="/v1/maps/{map}",
    tags=["calibration"],
    dependencies=[Depends(single_values)],
    responses=problem_documentation(
        errors.UnknownPlace,
        errors.UnknownSequence,
        errors.UnknownCamera,
        errors.RevisionMismatch,
        UnsupportedMediaType,
        errors.CalibrationImpossible,
        errors.InvalidImage,
        errors.NoRegions,
        QueueFull,
        JobQueueFull,
        EncoderNotInstalled,
        errors.StorageFull,
    ),
)

BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {"schema": {"$ref": "#/components/schemas/CalibrationOrder"}},
            FORM: {
                "schema": {
                    "type": "object",
                    "required": ["calibration"],
                    "properties": {"calibration": {"$ref": "#/components/schemas/CalibrationOrder"}},
                    "additionalProperties": {"type": "string", "format": "binary"},
                }
            },
        },
    }
}


@router.post(
    "/calibrate",
    openapi_extra=BODY,
    response_model=CalibrationReport,
    responses={202: {"model": JobView, "description": "The job that does it, if `background` is asked for."}},
)
async def calibrate_map(
    map_id: MapId, request: Request, engine: EngineDep, jobs: JobsDep, deadline: DeadlineDep, if_match: IfMatch = None
) -> CalibrationReport | Response:
    """Measure when a map's answers are to be believed, and make that its calibration.

    A JSON body asks the map with frames that it holds: those of one traverse, held against the others, or all of
    them. A form brings frames of its own, each a file part, and the same JSON in a part `calibration` that labels
    them. Threshold, margin and probability curve follow from the answers; what is told of their worth is
    cross-validated. A map that is too weak to calibrate so says so, and keeps the calibration it has.
    """
    map_ = await engine.map(map_id)
    expected = expected_revision(if_match, map_.record.revision)
    if media_type(request) == FORM:
        order, encodings = await _labelled_frames(engine, map_, request, deadline)
    else:
        order, encodings = await _order(request), []
    try:
        encoder = await in_thread(engine.catalogue.get, map_.record.encoder)
    except errors.UnknownEncoder as error:
        raise EncoderNotInstalled(str(error)) from error
    request.state.noted = {"map": map_id, "method": order.method}
    if order.background:
        arguments, maps = arguments_of(map_, order, expected), {map_id: creation_time(map_)}
        job = await in_thread(jobs.submit, KIND, map_id, arguments=arguments, maps=maps)
        return accepted(job, engine.settings)

    def advance(_done: int, _total: int) -> None:
        if deadline.seconds_left() <= 0:
            raise DeadlineExceeded(
                "The time was up before all was measured: ask in the background. Nothing was stored."
            )

    replaces = map_.record.calibration
    report = await in_thread(measured, map_, encoder, order, encodings, advance)
    if not order.dry_run:
        await in_thread(store, map_, report.calibration, replaces, expected)
    return report


async def _order(request: Request) -> CalibrationOrder:
    """The JSON body of a request.

    Raises:
        UnsupportedMediaType, MalformedBody, InvalidRequest.
    """
    kind = media_type(request)
    if kind != "application/json":
        raise UnsupportedMediaType(f"It is sent as application/json or {FORM}, not as {kind[:80] or 'nothing'}.")
    value = parse_json(await request.body(), "The body")
    json_size(value, "The body")
    order = validated(CalibrationOrder, value)
    if order.method == "frames":
        raise InvalidRequest("method: frames come in a form, with the order in its part 'calibration'.")
    return order


async def _labelled_frames(
    engine: Engine, map_: Map, request: Request, deadline: RequestDeadline
) -> tuple[CalibrationOrder, list[Encoding]]:
    """The order and the encoded frames of a form, in the order of its labels.

    Raises:
        InvalidRequest: the labels are not one for each frame.
        UnknownCamera: the map has none of a label's name.
        InvalidImage, NoRegions: one cannot be used; nothing is calibrated then.
    """
    engine.queue.check_room()
    value, others = json_part(await read_many(request, engine.settings), "calibration")
    json_size(value, "The part 'calibration'")
    order = validated(CalibrationOrder, value)
    if order.method != "frames" or order.labels is None:
        raise InvalidRequest("method: a form brings frames; the other methods are asked for by a JSON body.")
    files = {part.name: part for part in others}
    wanted = [label.file for label in order.labels]
    if not all(is_file(part) for part in others) or len(files) != len(others) or sorted(files) != sorted(wanted):
        raise InvalidRequest("labels: there must be one for each file part of the form, by its name.")
    for label in wanted:
        check_part(files[label], engine.settings)
    masks = [await camera_mask(map_, label.camera) for label in order.labels]
    with engine.queue.place(len(wanted)):
        outcomes = await engine.encode_all(map_.record.encoder, [files[name].data for name in wanted], deadline, masks)
    encodings = []
    for name, outcome in zip(wanted, outcomes, strict=True):
        if isinstance(outcome, Exception):
            raise outcome
        if not len(outcome.encoding.regions):
            raise errors.NoRegions(f"The frame {name[:80]!r} shows nothing to compare.")
        encodings.append(outcome.encoding)
    return order, encodings
