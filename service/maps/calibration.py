"""Calibrating a map: the route, and the job that does it in the background.

Frames whose places are known query the map.  Its threshold, margin and probability curve follow from its answers, and
become the map's own calibration unless an operator has set another one meanwhile.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from typing import Any, Final

from fastapi import APIRouter, Depends, Request, Response

from core import errors
from core.errors import RevisionMismatch
from core.judgement.acceptance import held_out_change
from core.judgement.calibration import FittedCalibration, Target, adjust_calibration
from core.judgement.trials import StagedTrials, Trials, joined_stages
from core.judgement.verdict import Calibration
from core.method.encoder import Encoder
from core.recognition.calibration import (
    LabelledQueries,
    ProgressCallback,
    adjust_to_labels,
    calibration_warnings,
    queries_from_labels,
    queries_from_map,
    queries_from_traverse,
)
from core.recognition.calibration import (
    calibrate_map as fit_calibration,
)
from core.recognition.stages import calibration_of
from core.store import Map, Snapshot
from service.engine.encoders import Encoded
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
from service.http.headers import expected_revision
from service.http.openapi import NAMED
from service.http.routing import DeadlineDep, EngineDep, IfMatch, MapId, single_values
from service.http.schemas import validated
from service.http.uploads import FORM, check_part, is_file, json_part, media_type, read_many
from service.jobs.context import JobContext, creation_time, encode_after_requests, progress_of
from service.jobs.routes import JobsDep, accepted
from service.jobs.schemas import JobView
from service.maps.calibration_preview import storable
from service.maps.schemas import MOST_FRAMES, CalibrationOrder, CalibrationReport
from service.places.map_events import tell_map
from service.queries.answers import StatisticsDep
from service.queries.histories.run_trials import RunTrials
from service.queries.statistics import QueryStatistics, map_key
from service.review.labels import KnownFrame, known_frames, parts, with_regions
from service.worker_threads import in_thread

log = logging.getLogger("placerec.calibration")

KIND = "calibrate"
"""The kind of the job."""

RUNS: Final = "runs"
"""The source of a calibration that rests on the runs of robots."""

ALIGNED: Final = "aligned:"
"""The source of a calibration that a map has made of an aligned traverse, whose name follows."""

UNCHANGED = "Curve, threshold and margin are those that are in force already, so there is nothing to store."

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
        errors.CalibrationWorse,
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
                    "propertyNames": NAMED,
                    "required": ["calibration"],
                    "properties": {"calibration": {"$ref": "#/components/schemas/CalibrationOrder"}},
                    "additionalProperties": {"type": "string", "format": "binary"},
                }
            },
        },
    }
}


# The route


@router.post(
    "/calibrate",
    openapi_extra=BODY,
    response_model=CalibrationReport,
    responses={202: {"model": JobView, "description": "The job that calibrates the map, if `background` is true."}},
)
async def calibrate_map(
    map_id: MapId,
    request: Request,
    engine: EngineDep,
    jobs: JobsDep,
    statistics: StatisticsDep,
    deadline: DeadlineDep,
    if_match: IfMatch = None,
) -> CalibrationReport | Response:
    """Measure when a map's answers can be believed, and store the result as the map's calibration.

    With a JSON body, the queried frames are the map's own: those of one traverse, compared with the others, or
    all of them, or those stored for review and labelled; or those of robots' runs. With a form, they are new frames:
    each is a file part, and a part `calibration` holds the same JSON with a label for each frame. The threshold, the
    margin and the probability curve follow from the answers; the reported quality is cross-validated. If the answers
    are too few or too poor to calibrate the map, or answers that had no part in it would become worse, the request is
    refused and the map keeps its calibration.
    """
    map_ = await engine.map(map_id)
    expected = expected_revision(if_match, map_.record.revision)
    if media_type(request) == FORM:
        order, encoded = await _read_labelled_frames(engine, map_, request, deadline)
    else:
        order, encoded = await _read_order(request), []
    known: list[KnownFrame] = []
    if order.method == "labels" and not order.background:
        known, encoded = await _encode_known(engine, map_, deadline)
    encoder = await engine.queue.load(map_.record.encoder)
    request.state.noted = {"map": map_id, "method": order.method}
    if order.background:
        arguments, maps = job_arguments(map_, order, expected), {map_id: creation_time(map_)}
        job = await in_thread(jobs.submit, KIND, map_id, arguments=arguments, maps=maps)
        return accepted(job, engine.settings)

    def advance(_done: int, _total: int) -> None:
        if deadline.seconds_left() <= 0:
            raise DeadlineExceeded(
                "The time ran out before the map was calibrated, and nothing was stored; use `background`."
            )

    replaces = map_.record.calibration
    ran = await in_thread(statistics.run_trials, map_key(map_)) if order.method == "runs" else []
    report, trials = await in_thread(measure, map_, encoder, order, encoded, advance, known, ran)
    await in_thread(remember, statistics, map_, report, trials)
    if not order.dry_run:
        await in_thread(_store_report, engine, map_, report, replaces, expected)
    return report


async def _read_order(request: Request) -> CalibrationOrder:
    """The JSON body of a request.

    Raises:
        UnsupportedMediaType, MalformedBody, InvalidRequest.
    """
    kind = media_type(request)
    if kind != "application/json":
        raise UnsupportedMediaType(f"Send the body as application/json or {FORM}, not as {kind[:80] or 'nothing'}.")
    value = parse_json(await request.body(), "The body")
    json_size(value, "The body")
    order = validated(CalibrationOrder, value)
    if order.method == "frames":
        raise InvalidRequest("method: send frames in a form, and this JSON in its part 'calibration'.")
    return order


async def _read_labelled_frames(
    engine: Engine, map_: Map, request: Request, deadline: RequestDeadline
) -> tuple[CalibrationOrder, list[Encoded]]:
    """The order in a form, and its frames encoded, in the order of the labels.

    Raises:
        UnsupportedMediaType, MalformedBody.
        InvalidRequest: there is not exactly one label for each frame.
        UnknownCamera: the map has no camera that a label names.
        InvalidImage, NoRegions: a frame cannot be used.
        QueueFull, EncoderNotInstalled.
    """
    engine.queue.check_room()
    value, others = json_part(await read_many(request, engine.settings), "calibration")
    json_size(value, "The part 'calibration'")
    order = validated(CalibrationOrder, value)
    if order.method != "frames" or order.labels is None:
        raise InvalidRequest("method: a form is for the method frames; send a JSON body for the other methods.")
    files = {part.name: part for part in others}
    names = [label.file for label in order.labels]
    if not all(is_file(part) for part in others) or len(files) != len(others) or sorted(files) != sorted(names):
        raise InvalidRequest("labels: there must be exactly one for each file part of the form, with its name.")
    for name in names:
        check_part(files[name], engine.settings)
    masks = [await camera_mask(map_, label.camera) for label in order.labels]
    frames, wanted = [files[name].data for name in names], map_.record.verification
    with engine.queue.place(len(names)):
        outcomes = await engine.encode_all(map_.record.encoder, frames, deadline, masks, keypoints=wanted)
    encoded = []
    for name, outcome in zip(names, outcomes, strict=True):
        if isinstance(outcome, Exception):
            raise outcome
        if not len(outcome.encoding.regions):
            raise errors.NoRegions(f"The frame {name[:80]!r} has no regions to compare.")
        encoded.append(outcome)
    return order, encoded


async def _encode_known(engine: Engine, map_: Map, deadline: RequestDeadline) -> tuple[list[KnownFrame], list[Encoded]]:
    """The labelled frames of the map's review, those that can be encoded, and their encodings.

    Raises:
        StorageFailure, EncoderNotInstalled.
    """
    frames, _ = await in_thread(known_frames, map_, MOST_FRAMES)
    found: list[tuple[KnownFrame, Encoded]] = []
    some = parts(map_, frames)
    while (part := await in_thread(next, some, None)) is not None:
        chosen, files, masks = part
        outcomes = await engine.encode_all(
            map_.record.encoder, files, deadline, masks, keypoints=map_.record.verification
        )
        found += with_regions(chosen, outcomes)
    return [frame for frame, _ in found], [encoded for _, encoded in found]


# Measuring and storing


def measure(
    map_: Map,
    encoder: Encoder,
    order: CalibrationOrder,
    encoded: Sequence[Encoded],
    advance: ProgressCallback,
    known: Sequence[KnownFrame] = (),
    ran: Sequence[RunTrials] = (),
) -> tuple[CalibrationReport, Trials]:
    """Ask a map the frames of an order, and report the calibration that follows; nothing is stored.

    Args:
        encoded: the frames of the order's labels, or of ``known``, in their order; empty for the other methods.
        known: the labelled frames of the map's review, for the method ``labels``.
        ran: the answers of the map to the frames of its latest runs, for the method ``runs``.

    Returns:
        The report, and the answers that it rests on.

    Raises:
        UnknownPlace, UnknownSequence, CalibrationImpossible, StorageFailure, and whatever ``advance`` raises.
    """
    if order.method == "runs":
        found = _from_runs(map_, encoder, ran, order.target)
        return _report(map_, encoder, order, found, calibration_warnings(found, "runs", order.target)), found.trials
    snapshot = map_.snapshot()
    queries = _queries(map_, snapshot, order, encoded, known)
    beside = queries_from_map(map_, snapshot, order.most) if (order.method, order.beside) == ("labels", "map") else None
    source = f"sequence:{order.sequence}" if order.method == "sequence" else order.method
    adjusted, drawn = (order.method, order.beside) == ("labels", "encoder"), None
    if adjusted:
        found, drawn = adjust_to_labels(map_, encoder, snapshot, queries, source, advance)
    else:
        found = fit_calibration(map_, encoder, snapshot, queries, order.target, source, advance, beside)
    method, target = ("adjusted", None) if adjusted else (order.method, order.target)
    warnings = calibration_warnings(found, method, target, queries.aligned)
    return _report(map_, encoder, order, found, warnings, drawn), found.trials


def _report(
    map_: Map,
    encoder: Encoder,
    order: CalibrationOrder,
    found: FittedCalibration,
    warnings: list[str],
    drawn: StagedTrials | None = None,
) -> CalibrationReport:
    """The report on a calibration.

    Args:
        drawn: answers to strangers that had no part in it, beside those that it was fitted to.
    """
    previous = calibration_of(map_, encoder)
    change = held_out_change(found, previous, drawn)
    same = _figures(found.calibration) == _figures(previous)
    return CalibrationReport(
        map=map_.record.id,
        encoder=encoder.identity,
        method=order.method,
        target=order.target,
        stored=not order.dry_run and not same and (change is None or change.worse is None),
        calibration=found.calibration,
        previous=previous,
        measurement=found.measurement,
        change=change,
        warnings=[*warnings, UNCHANGED] if same else warnings,
    )


def _figures(calibration: Calibration) -> Any:
    """What judges answers of a calibration, whatever it rests on; JSON without the last digits, which fitting moves."""
    told = calibration.model_dump_json(exclude={"source", "frames"})
    return json.loads(told, parse_float=lambda digits: f"{float(digits):.9g}")


def _store_report(
    engine: Engine, map_: Map, report: CalibrationReport, replaces: Calibration | None, expected: int | None
) -> None:
    """Store the calibration of a report, unless it is the one in force.

    Raises:
        CalibrationWorse: held-out answers speak against it.
        RevisionMismatch, StorageFull, StorageFailure: as of :func:`store`.
    """
    found = storable(report)
    if report.stored:
        store(map_, found, replaces, expected)
        tell_map(engine, map_, "calibrated")


def _from_runs(map_: Map, encoder: Encoder, ran: Sequence[RunTrials], target: Target) -> FittedCalibration:
    """The calibration of a person, or the encoder's, adjusted to the answers in some runs.

    Raises:
        CalibrationImpossible: there are too few, or the target is not a precision.
    """
    if target.rule != "precision":
        raise errors.CalibrationImpossible("From runs, the target can only be a precision.")
    if not ran:
        raise errors.CalibrationImpossible(
            "No run of a robot has told which places its frames show. Let the map learn (its setting learning: "
            "a mode other than off, calibration propose or auto), and drive with odometry; what a run says is there "
            "when its job of the kind learn is over."
        )
    own = map_.record.calibration
    base = encoder.calibration if own is None or by_itself(own) else own
    trials = joined_stages([one.trials for one in ran])
    return adjust_calibration(trials, base, RUNS, target, calibration_of(map_, encoder))


def by_itself(calibration: Calibration) -> bool:
    """Whether a map has found a calibration by itself, so that it may replace it by another one."""
    return calibration.source == RUNS or calibration.source.startswith(ALIGNED)


def remember(statistics: QueryStatistics, map_: Map, report: CalibrationReport, trials: Trials) -> None:
    """Keep what was measured, for those who ask what another threshold would change; a refusing disk is only logged."""
    try:
        statistics.keep_calibration(map_key(map_), report.model_dump_json(), json.dumps(trials.record()))
    except errors.PlacerecError as error:
        log.warning("the measurement of the calibration of %s is not stored: %s", map_.record.id, error)


def _queries(
    map_: Map,
    snapshot: Snapshot,
    order: CalibrationOrder,
    encoded: Sequence[Encoded],
    known: Sequence[KnownFrame],
) -> LabelledQueries:
    encodings, keypoints = [one.encoding for one in encoded], [one.keypoints for one in encoded]
    if order.method == "labels":
        if not known:
            raise errors.CalibrationImpossible("No frame of the map's review is labelled with a place that it has.")
        places = [frame.place for frame in known]
        return queries_from_labels(map_, snapshot, encodings, places, [frame.own for frame in known], keypoints)
    if order.method == "frames":
        assert order.labels is not None
        labels = [label.place for label in order.labels]
        return queries_from_labels(map_, snapshot, encodings, labels, keypoints=keypoints)
    if order.method == "sequence":
        assert order.sequence is not None
        return queries_from_traverse(map_, snapshot, order.sequence, order.pairs, order.most)
    return queries_from_map(map_, snapshot, order.most)


def store(map_: Map, calibration: Calibration, replaces: Calibration | None, expected: int | None) -> None:
    """Store a calibration as the map's own, unless the map was given another one since the calibration was ordered.

    Args:
        replaces: the map's own calibration at that time; None if it had none.
        expected: the revision that the map must have; None for any.

    Raises:
        RevisionMismatch: the map has another calibration or revision by now; it keeps its calibration.
        StorageFull, StorageFailure.
    """
    while True:
        record = map_.record
        if record.calibration != replaces:
            raise RevisionMismatch("The map was given another calibration meanwhile, which it keeps.")
        try:
            map_.edit({"calibration": calibration}, record.revision if expected is None else expected)
        except RevisionMismatch:
            if expected is not None:
                raise
        else:
            return


# The job


def job_arguments(map_: Map, order: CalibrationOrder, expected: int | None) -> dict[str, Any]:
    """The arguments of the job: the order, and what :func:`store` needs to know of the map as it is now."""
    replaces = map_.record.calibration
    return order.model_dump(mode="json") | {
        "revision": expected,
        "replaces": None if replaces is None else replaces.model_dump(mode="json"),
    }


def run_job(engine: Engine, statistics: QueryStatistics, context: JobContext) -> Mapping[str, Any]:
    """Calibrate a map as a job; an attempt after a restart begins again unless the calibration was stored already.

    Raises:
        UnknownMap, UnknownSequence, UnknownPlace, EncoderNotInstalled, CalibrationImpossible, CalibrationWorse,
            RevisionMismatch, StorageFull, StorageFailure: the map keeps its calibration.
        JobCancelled, JobInterrupted.
    """
    map_ = context.map(engine.maps)
    arguments = dict(context.arguments)
    expected, replaces = arguments.pop("revision"), arguments.pop("replaces")
    order = CalibrationOrder.model_validate(arguments)
    if (noted := context.notes.get("report")) is not None:
        report = CalibrationReport.model_validate(noted)
        if map_.record.calibration == report.calibration:
            return report.model_dump(mode="json")  # the process was killed after the commit

    encoder = engine.load_encoder(map_)
    known: list[KnownFrame] = []
    encoded: list[Encoded] = []
    if order.method == "labels":
        known, encoded = _encode_known_after_requests(engine, context, map_)
    ran = statistics.run_trials(map_key(map_)) if order.method == "runs" else []
    report, trials = measure(map_, encoder, order, encoded, progress_of(engine, context), known, ran)
    remember(statistics, map_, report, trials)
    result = report.model_dump(mode="json")
    if not order.dry_run:
        context.remember(report=result)
        before = None if replaces is None else Calibration.model_validate(replaces)
        _store_report(engine, map_, report, before, expected)
    return result


def _encode_known_after_requests(
    engine: Engine, context: JobContext, map_: Map
) -> tuple[list[KnownFrame], list[Encoded]]:
    """:func:`_encode_known` in a job, which lets requests go first."""
    found: list[tuple[KnownFrame, Encoded]] = []
    for chosen, files, masks in parts(map_, known_frames(map_, MOST_FRAMES)[0]):
        wanted = map_.record.verification
        found += with_regions(chosen, encode_after_requests(engine, context, map_.record.encoder, files, masks, wanted))
    return [frame for frame, _ in found], [encoded for _, encoded in found]
