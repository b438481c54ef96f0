"""Loop closure: locate a frame in a map and, if its place is unknown, enrol it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Query, Request
from starlette.responses import Response

from core import errors
from core.belief import view_of
from core.maps.selection import Selection
from core.places import Place, check_place_id
from core.recognition.question import Question
from core.recognition.recognition import Answer, answer_to_blank, locate
from core.store import Map
from service.engine.encoders import Encoded
from service.engine.engine import Engine, camera_mask
from service.errors.faults import (
    EncoderNotInstalled,
    PlaceTaken,
    QueueFull,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.http.openapi import frame_body
from service.http.routing import (
    DeadlineDep,
    EngineDep,
    MapId,
    frame_for_map,
    milliseconds_since,
    rounded,
    single_values,
    started,
)
from service.http.uploads import parse_metadata
from service.places.enrolment import FrameToEnrol, describe_frame, digest_of
from service.places.place_events import tell_enrolment
from service.places.schemas import PlaceView
from service.queries.answers import StatisticsDep, answer_of
from service.queries.following import follow_answer
from service.queries.given_answers import QueriedFrame
from service.queries.parameters import ClosureParameters
from service.queries.schemas import ClosureAnswer
from service.worker_threads import in_thread


@dataclass(frozen=True)
class Closure:
    """The result of a loop closure.

    answer: the answer of the map before the frame was enrolled.
    enrolled: the frame's own place; None if the frame shows, or may show, another place, or hardly anything.
    created: whether the place was created by this request.
    """

    answer: Answer
    enrolled: Place | None
    created: bool


def close_loop(
    engine: Engine,
    map_: Map,
    frame: FrameToEnrol,
    encoded: Encoded,
    question: Question,
) -> Closure:
    """Locate a frame and, if the verdict is ``unknown``, enrol it; blocks, so call it in a thread.

    A uniform view, such as that of a covered camera, is not enrolled: every other one would be found to show its place.

    The map is locked meanwhile: if two frames of one new place arrive together, the second finds the first.  A
    repeated request gets the same answer as the first one, because its own place is left out of the search.

    Args:
        encoded: the frame, encoded; it has regions.

    Raises:
        PlaceTaken: a place of the frame's id exists, and has another frame.
        UnknownSequence: only places of a traverse are allowed that the map does not have, and it is not the frame's
            own, which begins with it.
        StorageFull, StorageFailure: nothing was enrolled.
    """
    filters = (question.selection or Selection()).filters
    others = [name for name in filters.sequences or () if name != frame.fields.sequence]
    if others and (absent := map_.unknown_sequences(others)):
        raise errors.UnknownSequence(f"The map has no sequence {min(absent)[:128]!r}, so the frame would seem new.")
    digest = digest_of(frame)
    enrolment = describe_frame(engine, map_, frame, digest, encoded)
    with engine.writing(map_.record.id):
        known = map_.digest(frame.id)
        if known is not None and known != digest:
            raise PlaceTaken(f"The place {frame.id!r} has another frame; PUT replaces it.")
        if known is not None:
            selection = replace(question.selection or Selection(), excluded=frame.id)
            question = replace(question, selection=selection)
        (answer,) = locate(map_, encoded.encoder, [encoded.query(question)])
        if known is not None:
            return Closure(answer, map_.place(frame.id), created=False)
        if answer.judgement.verdict != "unknown" or view_of(encoded.pixels, frame.mask).uniform:
            return Closure(answer, None, created=False)
        ((place, change),) = map_.enrol([enrolment])
        tell_enrolment(engine, map_, [(place, change)])
        return Closure(answer, place, created=True)


router = APIRouter(
    prefix="/v1/maps/{map}",
    tags=["queries"],
    dependencies=[Depends(single_values)],
    responses=problem_documentation(
        errors.UnknownCamera,
        errors.UnknownSequence,
        errors.WrongEncoder,
        errors.MixedCoordinates,
        PlaceTaken,
        UnsupportedMediaType,
        errors.StorageFull,
        QueueFull,
        EncoderNotInstalled,
    ),
)


@router.post(
    "/query:enrol",
    openapi_extra=frame_body(ClosureParameters),
    responses={201: {"model": ClosureAnswer, "description": "The frame was unknown and is a new place now."}},
)
async def query_or_enrol(
    map_id: MapId,
    options: Annotated[ClosureParameters, Query()],
    request: Request,
    response: Response,
    engine: EngineDep,
    statistics: StatisticsDep,
    deadline: DeadlineDep,
) -> ClosureAnswer:
    """Locate one frame in a map and, if the verdict is `unknown`, enrol it as the place `id`, as one step.

    If two robots send the same new place at the same time, one enrols it and the other finds it. A request can be
    repeated until it succeeds: the same frame with the same id is located among the other places, and not enrolled
    again. `exclude_frames` and `exclude_seconds` leave out a robot's own last frames. A frame without
    regions is not enrolled, nor is one that shows hardly anything, as behind a covered lens.
    """
    map_, data, options = await frame_for_map(request, engine, map_id, options)
    question = options.question()
    check_place_id(options.id)
    metadata = {} if options.metadata is None else parse_metadata(options.metadata)
    fields = options.fields(metadata, engine.settings)
    mask = await camera_mask(map_, options.camera)
    with engine.queue.place():
        encoded = await engine.queue.encode(
            map_.record.encoder, data, deadline, mask, keypoints=map_.record.verification
        )
    enrolled: Place | None = None
    change: Literal["created", "unchanged"] | None = None
    if len(encoded.encoding.regions) == 0:
        answer = answer_of(map_, encoded, answer_to_blank(map_, encoded.encoder, encoded.encoding))
    else:
        frame = FrameToEnrol(options.id, fields, data, mask)
        closure = await in_thread(close_loop, engine, map_, frame, encoded, question)
        answer = answer_of(map_, encoded, closure.answer, statistics.usual(map_))
        enrolled = closure.enrolled
        if enrolled is not None:
            change = "created" if closure.created else "unchanged"
    response.status_code = 201 if change == "created" else 200
    request.state.noted = {"map": map_id, "verdict": answer.verdict, "change": change}
    answer.milliseconds |= rounded({"total": milliseconds_since(started(request))})
    queried = QueriedFrame(options.camera, question=options.again(), taken=options.timestamp)
    follow_answer(engine, statistics, map_, answer, data, queried)
    shown = None if enrolled is None else PlaceView.of(enrolled)
    return ClosureAnswer(**answer.__dict__, enrolment=change, enrolled=shown)
