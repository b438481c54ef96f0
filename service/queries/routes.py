"""Queries: where was this frame taken?"""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request

from core import errors
from service.engine.engine import camera_mask, in_thread
from service.engine.queue import Encoded
from service.errors.faults import (
    EncoderNotInstalled,
    InvalidRequest,
    QueueFull,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.http.dependencies import EngineDep, MapId, PatienceDep, milliseconds_since, rounded, single_values, started
from service.http.openapi import form_body, frame_body
from service.http.route_classes import QuickRoute
from service.http.uploads import check_part, read_frame, read_many, split_form
from service.places.batches import item_problem
from service.queries.answers import answer_queries, search_ahead
from service.queries.explanations import as_drawn, explained_match
from service.queries.parameters import QueryParameters
from service.queries.schemas import BatchAnswer, BatchAnswers, QueryAnswer

router = APIRouter(
    prefix="/v1/maps/{map}",
    tags=["queries"],
    route_class=QuickRoute,
    dependencies=[Depends(single_values)],
    responses=problem_documentation(
        errors.UnknownCamera, errors.WrongEncoder, UnsupportedMediaType, QueueFull, EncoderNotInstalled
    ),
)
QueryOptions = Annotated[QueryParameters, Query()]


@router.post(
    "/query",
    openapi_extra=frame_body(QueryParameters),
    responses=problem_documentation(errors.TooManyPixels, errors.NotAnImage, errors.TruncatedImage),
)
async def query(
    map_id: MapId, options: QueryOptions, request: Request, engine: EngineDep, patience: PatienceDep
) -> QueryAnswer:
    """Locate one frame in a map.

    `place` is given only with the verdict `recognized`; `matches` lists the best places whatever the
    verdict. A place that nobody enrolled is `unknown`, which is an answer and no error.
    """
    engine.inference.check_room()
    map_ = await engine.map(map_id)
    frame = await read_frame(request, engine.settings)
    options = options.joined(frame.fields)
    selection = options.selection()
    engine.assert_encoder(map_, options.encoder)
    mask = await camera_mask(map_, options.camera)
    with engine.inference.place_in_queue():
        ahead = search_ahead(map_, options.k, selection)
        encoded = await engine.encode_for(map_, frame.data, patience, mask, ahead)
    (answer,) = await answer_queries(engine, map_, [encoded], options.k, selection)
    if options.explain and answer.matches:
        encoded = await in_thread(as_drawn, encoded)
        answer.explanation = await explained_match(engine, map_, encoded, answer.matches[0].place.id, patience)
    answer.milliseconds |= rounded({"total": milliseconds_since(started(request))})
    request.state.noted = {"map": map_id, "verdict": answer.verdict}
    return answer


@router.post(
    "/query:batch",
    response_model_exclude_unset=True,
    openapi_extra=form_body("The frames, each a file part under a name of its own.", {}, []),
)
async def query_batch(
    map_id: MapId, options: QueryOptions, request: Request, engine: EngineDep, patience: PatienceDep
) -> BatchAnswers:
    """Locate many frames in a map; one that is bad fails alone."""
    engine.inference.check_room()
    map_ = await engine.map(map_id)
    files, fields = split_form(await read_many(request, engine.settings))
    options = options.joined(fields)
    selection = options.selection()
    engine.assert_encoder(map_, options.encoder)
    if options.explain:
        raise InvalidRequest("explain: frames are explained one by one, by a query of their own.")
    mask = await camera_mask(map_, options.camera)
    if not files:
        raise InvalidRequest("The form has no file part.")
    engine.metrics.batches.labels("query").observe(len(files))
    items = [BatchAnswer(file=part.name, status=200) for part in files]
    encoded: dict[int, Encoded] = {}
    with engine.inference.place_in_queue(len(files)):
        outcomes = await engine.encode_all_for(map_, [part.data for part in files], patience, [mask] * len(files))
        for index, (part, outcome) in enumerate(zip(files, outcomes, strict=True)):
            try:
                check_part(part, engine.settings)
                if isinstance(outcome, Exception):
                    raise outcome
                encoded[index] = outcome
            except Exception as error:
                problem = item_problem(request, error)
                items[index] = BatchAnswer(file=part.name, status=problem.status, problem=problem)
    answers = await answer_queries(engine, map_, list(encoded.values()), options.k, selection)
    for index, answer in zip(encoded, answers, strict=True):
        items[index].answer = answer
    request.state.noted = {"map": map_id, "frames": len(files)}
    total = rounded({"total": milliseconds_since(started(request))})
    return BatchAnswers(items=items, encoder=map_.record.encoder, milliseconds=total)
