"""Routes of queries: one frame, many frames, and the pictures of explanations."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Request
from starlette.responses import Response

from core import errors
from service.engine.encoders import Encoded
from service.engine.engine import camera_mask
from service.errors.faults import (
    EncoderNotInstalled,
    InvalidRequest,
    NoGeoPose,
    NotLocalized,
    QueueFull,
    UnknownExplanation,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.http.openapi import BINARY, form_body, frame_body
from service.http.routing import (
    DeadlineDep,
    EngineDep,
    FromState,
    MapId,
    StrictRoute,
    frame_for_map,
    milliseconds_since,
    rounded,
    single_values,
    started,
)
from service.http.uploads import check_part, read_many, split_form
from service.places.batches import frame_problem
from service.poses.geoposes import VARY, Located, geopose_content, negotiated
from service.queries.answers import StatisticsDep, answer_of, estimate_at
from service.queries.explanations import explain_match, scaled_for_drawing
from service.queries.following import follow_answer
from service.queries.given_answers import QueriedFrame
from service.queries.parameters import QueryParameters, SingleQueryParameters
from service.queries.pictures import ExplanationPictures
from service.queries.schemas import BatchAnswer, BatchAnswers, QueryAnswer
from service.queries.statistics import map_key
from service.worker_threads import in_thread

router = APIRouter(
    prefix="/v1/maps/{map}",
    tags=["queries"],
    dependencies=[Depends(single_values)],
    responses=problem_documentation(
        errors.UnknownCamera,
        errors.WrongEncoder,
        errors.MixedCoordinates,
        UnsupportedMediaType,
        QueueFull,
        EncoderNotInstalled,
    ),
)
explanations = APIRouter(
    prefix="/v1/maps/{map}/explanations",
    tags=["queries"],
    route_class=StrictRoute,
    dependencies=[Depends(single_values)],
)
QueryOptions = Annotated[QueryParameters, Query()]
SingleQueryOptions = Annotated[SingleQueryParameters, Query()]
PicturesDep = Annotated[ExplanationPictures, Depends(FromState("explanation_pictures"))]


@router.post(
    "/query",
    response_model=QueryAnswer,
    openapi_extra=frame_body(SingleQueryParameters),
    responses={
        200: geopose_content(),
        **problem_documentation(
            errors.TooManyPixels, errors.NotAnImage, errors.TruncatedImage, NotLocalized, NoGeoPose
        ),
    },
)
async def query(
    map_id: MapId,
    options: SingleQueryOptions,
    request: Request,
    response: Response,
    engine: EngineDep,
    statistics: StatisticsDep,
    pictures: PicturesDep,
    deadline: DeadlineDep,
) -> Any:
    """Locate one frame in a map.

    `place` is given only with the verdict `recognized`; `matches` lists the best places with any
    verdict. A place that was never enrolled is `unknown`, which is an answer and no error.

    With `Accept: application/geopose+json` the answer of a map in latitude and longitude is an OGC GeoPose. Where there
    is none it is JSON, if the header allows that, else 404 `not-localized` or 406 `no-geopose`.
    """
    map_, data, options = await frame_for_map(request, engine, map_id, options)
    answered = await engine.ask(map_, data, options.question(), deadline)
    answer = answer_of(map_, answered.frame, answered.answer, statistics.usual(map_))
    if options.explain and answered.answer.matches:
        encoded = await in_thread(scaled_for_drawing, answered.frame)
        answer.explanation = await explain_match(engine, pictures, map_, encoded, answered.answer, deadline)
    answer.milliseconds |= rounded({"total": milliseconds_since(started(request))})
    request.state.noted = {"map": map_id, "verdict": answer.verdict}
    follow_answer(engine, statistics, map_, answer, data, QueriedFrame(options.camera, question=options.again()))
    response.headers.update(VARY)
    place = answer.place.id if answer.place is not None else None
    located = Located(
        answer.verdict, map_id, place, answer.probability, estimate_at(answered.answer.pose, answer.place)
    )
    return negotiated(request.headers.get("accept"), options.format).response(located) or answer


@router.post(
    "/query:batch",
    response_model_exclude_unset=True,
    openapi_extra=form_body("The frames, each a file part with a name of its own.", {}, []),
)
async def query_batch(
    map_id: MapId,
    options: QueryOptions,
    request: Request,
    engine: EngineDep,
    statistics: StatisticsDep,
    deadline: DeadlineDep,
) -> BatchAnswers:
    """Locate many frames in a map; a bad frame fails alone."""
    engine.queue.check_room()
    map_ = await engine.map(map_id)
    files, fields = split_form(await read_many(request, engine.settings))
    options = options.joined(fields)
    question = options.question()
    engine.assert_encoder(map_, options.encoder)
    if options.explain:
        raise InvalidRequest("explain: a batch cannot be explained; send the frame as a single query.")
    mask = await camera_mask(map_, options.camera)
    if not files:
        raise InvalidRequest("The form has no file part.")
    engine.metrics.batches.labels("query").observe(len(files))
    items = [BatchAnswer(file=part.name, status=200) for part in files]
    encoded: dict[int, Encoded] = {}
    with engine.queue.place(len(files)):
        outcomes = await engine.encode_all(
            map_.record.encoder,
            [part.data for part in files],
            deadline,
            [mask] * len(files),
            keep_scaled=question.verify != "never",
        )
        for index, (part, outcome) in enumerate(zip(files, outcomes, strict=True)):
            try:
                check_part(part, engine.settings)
                if isinstance(outcome, Exception):
                    raise outcome
                encoded[index] = outcome
            except Exception as error:
                problem = frame_problem(request, error)
                items[index] = BatchAnswer(file=part.name, status=problem.status, problem=problem)
    answered = await engine.searches.answer(map_, list(encoded.values()), question)
    queried, usual = QueriedFrame(options.camera, question=options.again()), statistics.usual(map_)
    for index, one in zip(encoded, answered, strict=True):
        answer = items[index].answer = answer_of(map_, one.frame, one.answer, usual)
        follow_answer(engine, statistics, map_, answer, files[index].data, queried, file=files[index].name)
    request.state.noted = {"map": map_id, "frames": len(files)}
    total = rounded({"total": milliseconds_since(started(request))})
    return BatchAnswers(items=items, encoder=map_.record.encoder, milliseconds=total)


@explanations.get(
    "/{explanation}",
    response_class=Response,
    responses={
        200: {"description": "Both frames side by side.", "content": {"image/png": {"schema": BINARY}}},
        **problem_documentation(UnknownExplanation),
    },
)
def see_explanation(
    map_id: MapId,
    name: Annotated[
        str, Path(alias="explanation", max_length=64, description="Name of the picture, from the answer to the query.")
    ],
    engine: EngineDep,
    pictures: PicturesDep,
) -> Response:
    """Fetch the picture of an explanation: the query beside its best match, with lines between matching cells.

    Without a second stage the lines join matching regions.

    `picture` in the explanation of a query is the path; the latest pictures can be fetched for some minutes.
    """
    picture = pictures.fetch(map_key(engine.maps.find(map_id)), name)
    return Response(picture, media_type="image/png", headers={"Cache-Control": "private, max-age=600"})
