"""Queries: where was this frame taken?"""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request

from core import errors
from core.storage import Map
from service.batches import item_problem
from service.dependencies import EngineDep, MapId, PatienceDep, milliseconds_since, rounded, single_values, started
from service.engine import Engine, in_thread
from service.faults import (
    BodyTooLarge,
    DeadlineExceeded,
    EncoderNotInstalled,
    InvalidRequest,
    MalformedBody,
    QueueFull,
    UnsupportedMediaType,
)
from service.inference import Encoded
from service.localization import Located, locate
from service.openapi import form_body, frame_body
from service.parameters import QueryParameters
from service.problems import problem_documentation
from service.schemas.places import PlaceView
from service.schemas.queries import BatchAnswer, BatchAnswers, Match, QueryAnswer
from service.uploads import check_part, read_frame, read_many, split_form

router = APIRouter(
    prefix="/v1/maps/{map}",
    tags=["queries"],
    dependencies=[Depends(single_values)],
    responses=problem_documentation(
        MalformedBody,
        errors.UnknownMap,
        errors.WrongEncoder,
        BodyTooLarge,
        UnsupportedMediaType,
        InvalidRequest,
        QueueFull,
        DeadlineExceeded,
        EncoderNotInstalled,
        errors.MapQuarantined,
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
    engine.assert_encoder(map_, options.encoder)
    with engine.inference.place_in_queue():
        encoded = await engine.encode_for(map_, frame.data, patience)
    answer = (await _locate(engine, map_, [encoded], options.k))[0]
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
    engine.assert_encoder(map_, options.encoder)
    if not files:
        raise InvalidRequest("The form has no file part.")
    engine.metrics.batches.labels("query").observe(len(files))
    items = [BatchAnswer(file=part.name, status=200) for part in files]
    encoded: dict[int, Encoded] = {}
    with engine.inference.place_in_queue():
        for index, part in enumerate(files):
            try:
                check_part(part, engine.settings)
                encoded[index] = await engine.encode_for(map_, part.data, patience)
            except Exception as error:
                problem = item_problem(request, error)
                items[index] = BatchAnswer(file=part.name, status=problem.status, problem=problem)
    answers = await _locate(engine, map_, list(encoded.values()), options.k)
    for index, answer in zip(encoded, answers, strict=True):
        items[index].answer = answer
    request.state.noted = {"map": map_id, "frames": len(files)}
    total = rounded({"total": milliseconds_since(started(request))})
    return BatchAnswers(items=items, encoder=map_.record.encoder, milliseconds=total)


async def _locate(engine: Engine, map_: Map, encoded: list[Encoded], k: int) -> list[QueryAnswer]:
    """The answers to frames that were encoded, in their order."""
    seen = [one for one in encoded if len(one.encoding.regions)]
    encodings = [one.encoding for one in seen]
    located = await in_thread(locate, map_, seen[0].encoder, encodings, k) if seen else []
    remaining = iter(located)
    answers = []
    for one in encoded:
        answer = _answer(one, next(remaining)) if len(one.encoding.regions) else _blank(map_, one)
        engine.metrics.observe_answer(map_.record.id, answer.verdict, answer.score)
        if "search" in answer.milliseconds:
            engine.metrics.searches.observe(answer.milliseconds["search"] / 1e3)
        answers.append(answer)
    return answers


def _answer(encoded: Encoded, located: Located) -> QueryAnswer:
    judgement = located.judgement
    matches = [
        Match(rank=rank, score=score, place=PlaceView.of(place))
        for rank, (score, place) in enumerate(located.matches, start=1)
    ]
    return QueryAnswer(
        verdict=judgement.verdict,
        place=matches[0].place if judgement.verdict == "recognized" else None,
        score=judgement.score,
        margin=judgement.margin,
        decision=judgement.decision,
        threshold=located.calibration.threshold,
        reason="empty-map" if judgement.score is None else None,
        matches=matches,
        encoder=encoded.encoder.identity,
        milliseconds=rounded({**encoded.milliseconds, "search": located.search}),
    )


def _blank(map_: Map, encoded: Encoded) -> QueryAnswer:
    """The answer to a frame without regions: there is nothing to compare."""
    return QueryAnswer(
        verdict="unknown",
        place=None,
        score=None,
        margin=None,
        decision=None,
        threshold=(map_.record.calibration or encoded.encoder.calibration).threshold,
        reason="no-regions",
        matches=[],
        encoder=encoded.encoder.identity,
        milliseconds=rounded(encoded.milliseconds),
    )
