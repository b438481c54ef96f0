"""The route of queries of several maps, with the frames of one camera or of a rig."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Query, Request
from starlette.responses import Response

from core import errors
from core.judgement.probability import sigmoid
from core.recognition.recognition import answer_to_blank
from service.engine.encoders import Encoded
from service.engine.engine import Engine
from service.errors.faults import (
    InvalidRequest,
    NoGeoPose,
    NotLocalized,
    QueueFull,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation, request_problem
from service.http.openapi import frames_body
from service.http.routing import (
    DeadlineDep,
    EngineDep,
    PrincipalDep,
    milliseconds_since,
    rounded,
    single_values,
    started,
)
from service.http.uploads import FORM, check_part, media_type, read_frame, read_many, split_form
from service.places.batches import frame_problem
from service.places.schemas import PlaceView
from service.poses.geoposes import VARY, Located, geopose_content, negotiated
from service.queries.answers import StatisticsDep, answer_of, estimate_at, estimated_pose
from service.queries.following import follow_answer
from service.queries.given_answers import QueriedFrame
from service.queries.multi_map import MapReport, RigFrame, judge_together, locate_in_maps, match_log_odds
from service.queries.parameters import MultiMapParameters
from service.queries.schemas import FrameReport, MapAnswer, MapMatch, QueryAnswer, Reason, SeveralAnswer
from service.queries.statistics import QueryStatistics
from service.worker_threads import in_thread

router = APIRouter(
    prefix="/v1",
    tags=["queries"],
    dependencies=[Depends(single_values)],
    responses=problem_documentation(UnsupportedMediaType, errors.InvalidIdentifier, errors.InvalidImage, QueueFull),
)

MOST_FRAMES = 16
"""The most cameras of a rig."""


@router.post(
    "/query",
    response_model=SeveralAnswer,
    openapi_extra=frames_body(MultiMapParameters),
    responses={200: geopose_content(), **problem_documentation(NotLocalized, NoGeoPose)},
)
async def query_maps(
    options: Annotated[MultiMapParameters, Query()],
    request: Request,
    response: Response,
    engine: EngineDep,
    statistics: StatisticsDep,
    principal: PrincipalDep,
    deadline: DeadlineDep,
) -> Any:
    """Locate the frames of one moment in several maps; the matches are ranked together by calibrated probability.

    A form with several file parts is one query of a rig: the evidence of its cameras is added up place by place, so
    the frames must be of one moment; blank frames are ignored. A map that is damaged, unknown or lacks its encoder is
    reported, and the other maps answer all the same. `place` is given only with the verdict `recognized`: the most
    probable match is recognized in its own map, and no other map has a match of another place that is nearly as
    probable.

    With `Accept: application/geopose+json` the answer is an OGC GeoPose as that of one map is.
    """
    engine.queue.check_room()
    frames, broken, options = await _frames(request, options, engine)
    question = options.question()
    map_ids = options.map_ids()
    if map_ids is None:
        map_ids = [map_id for map_id in await in_thread(_all_maps, engine) if principal.may_use(map_id)]
    principal.require(*map_ids)
    with engine.queue.place():
        reports = await locate_in_maps(engine, map_ids, frames, question, deadline)
    shown = _frame_reports(request, frames, reports)
    together = judge_together(reports)
    recognized = together.best if together.verdict == "recognized" else None
    wholes = [_whole_answer(report, statistics) for report in reports]
    answers = [_map_answer(request, report, whole) for report, whole in zip(reports, wholes, strict=True)]
    queried, data = QueriedFrame(frames[0].camera, question=options.again()), frames[0].data
    total = rounded({"total": milliseconds_since(started(request))})
    for report, whole in zip(reports, wholes, strict=True):
        if report.map_ is None or whole is None:
            continue
        # Of several maps only the one that recognized the place counts: the frame says nothing about the others.
        counts = report is recognized or len(reports) == 1
        # A frame whose place is recognized is in no doubt for the maps that do not know the place.
        in_doubt_here = together.verdict != "recognized" or report is recognized
        follow_answer(
            engine, statistics, report.map_, whole, data, queried,
            milliseconds=total, count=counts, review=in_doubt_here,
        )  # fmt: skip
    matches = _matches(reports, options.k)
    place = pose = None
    if recognized is not None and recognized.answer is not None:
        place = PlaceView.of(recognized.answer.matches[0][1])
        pose = estimated_pose(recognized.answer.pose, place)
    request.state.noted = {"maps": len(map_ids), "frames": len(frames), "verdict": together.verdict}
    response.headers.update(VARY)
    located = Located(
        together.verdict,
        None if recognized is None else recognized.map_id,
        None if place is None else place.id,
        together.probability,
        None if recognized is None or recognized.answer is None else estimate_at(recognized.answer.pose, place),
    )
    if (found := negotiated(request.headers.get("accept"), options.format).response(located)) is not None:
        return found
    return SeveralAnswer(
        verdict=together.verdict,
        map=None if recognized is None else recognized.map_id,
        place=place,
        probability=together.probability,
        pose=pose,
        matches=matches,
        maps=answers,
        frames=[*shown, *broken],
        milliseconds=total,
    )


def _all_maps(engine: Engine) -> list[str]:
    return sorted({record.id for record in engine.all_records()} | set(engine.maps.quarantined()))


async def _frames(
    request: Request, options: MultiMapParameters, engine: Engine
) -> tuple[list[RigFrame], list[FrameReport], MultiMapParameters]:
    """The frames that can be decoded, reports of the others, and the parameters together with the form's fields."""
    if media_type(request) != FORM:
        frame = await read_frame(request, engine.settings)
        if options.cameras is not None:
            raise InvalidRequest("cameras: a raw body has no parts; give the name of its camera as camera.")
        return [RigFrame("image", frame.data, options.camera)], [], options
    files, fields = split_form(await read_many(request, engine.settings))
    options = options.joined(fields)
    names = [part.name for part in files]
    if not 1 <= len(files) <= MOST_FRAMES or len(set(names)) < len(names):
        raise InvalidRequest(f"The form needs 1 to {MOST_FRAMES} file parts with different names.")
    cameras = options.camera_of(names)
    frames: list[RigFrame] = []
    broken: list[FrameReport] = []
    first: Exception | None = None
    for part in files:
        try:
            check_part(part, engine.settings)
            frames.append(RigFrame(part.name, part.data, cameras.get(part.name)))
        except Exception as error:
            problem = frame_problem(request, error)
            first = first or error
            report = FrameReport(frame=part.name, camera=cameras.get(part.name), status=problem.status, problem=problem)
            broken.append(report)
    if first is not None and not frames:
        raise first
    return frames, broken, options


def _frame_reports(request: Request, frames: Sequence[RigFrame], reports: Sequence[MapReport]) -> list[FrameReport]:
    """A report for each frame; if none could be encoded, the error of the first one is raised."""
    found: list[FrameReport] = []
    first: Exception | None = None
    outcomes = next((report.frames for report in reports if report.frames), ())
    for index, frame in enumerate(frames):
        outcome = outcomes[index] if outcomes else None
        if isinstance(outcome, Exception):
            first = first or outcome
            problem = frame_problem(request, outcome)
            found.append(FrameReport(frame=frame.name, camera=frame.camera, status=problem.status, problem=problem))
        else:
            regions = len(outcome.encoding.regions) if isinstance(outcome, Encoded) else None
            found.append(FrameReport(frame=frame.name, camera=frame.camera, status=200, regions=regions))
    if first is not None and all(report.problem is not None for report in found):
        raise first
    return found


def _map_answer(request: Request, report: MapReport, answer: QueryAnswer | None) -> MapAnswer:
    """The entry of one map; ``answer`` is its whole answer, None if it gave none."""
    encoder = None if report.map_ is None else report.map_.record.encoder
    if report.error is not None:
        problem = request_problem(request, report.error)
        return MapAnswer(map=report.map_id, status=problem.status, encoder=encoder, problem=problem)
    if report.answer is None or answer is None:
        reason: Reason | None = "no-regions" if answer is None else answer.reason
        return MapAnswer(map=report.map_id, status=200, verdict="unknown", reason=reason, encoder=encoder)
    return MapAnswer(
        map=report.map_id,
        status=200,
        verdict=answer.verdict,
        probability=answer.probability,
        change=answer.change,
        score=answer.score,
        margin=answer.margin,
        decision=answer.decision,
        threshold=answer.threshold,
        reason=answer.reason,
        verification=answer.verification,
        rivals=answer.rivals,
        revision=answer.revision,
        encoder=encoder,
    )


def _whole_answer(report: MapReport, statistics: QueryStatistics) -> QueryAnswer | None:
    """The answer of a report as one query of its map would give it; None if the map did not answer."""
    frames = [one for one in report.frames if isinstance(one, Encoded)]
    seen = next((one for one in frames if len(one.encoding.regions)), frames[0] if frames else None)
    if report.map_ is None or report.error is not None or seen is None:
        return None
    found = report.answer or answer_to_blank(report.map_, seen.encoder, seen.encoding)
    return answer_of(report.map_, seen, found, statistics.usual(report.map_))


def _matches(reports: Sequence[MapReport], k: int) -> list[MapMatch]:
    """The ``k`` most probable matches of all maps, best first."""
    found: list[tuple[float, MapMatch]] = []
    for report in reports:
        if report.answer is None:
            continue
        weights: Sequence[float | None] = report.answer.weights or [None] * len(report.answer.matches)
        is_calibrated = report.answer.probability is not None
        for odds, (score, place), weight in zip(match_log_odds(report), report.answer.matches, weights, strict=True):
            probability = float(sigmoid(np.array(odds))) if is_calibrated else None
            match = MapMatch(
                rank=0,
                map=report.map_id,
                probability=probability,
                score=score,
                weight=weight,
                place=PlaceView.of(place),
            )
            found.append((odds, match))
    best = sorted(found, key=lambda item: -item[0])[:k]
    return [match.model_copy(update={"rank": rank}) for rank, (_, match) in enumerate(best, start=1)]
