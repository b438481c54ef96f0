"""A map calibrated by what is asked of it, at once or as a job, and never over what an operator has set meanwhile."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from core.errors import RevisionMismatch
from core.judgement.verdict import Calibration
from core.method.encoder import Encoder, Encoding
from core.recognition.calibration import (
    TOGETHER,
    LabelledQueries,
    ProgressCallback,
    calibrate_map,
    calibration_warnings,
    queries_from_labels,
    queries_from_map,
    queries_from_traverse,
)
from core.recognition.stages import calibration_of
from core.storage import Map, Snapshot
from service.engine.engine import Engine
from service.jobs.context import JobContext, yield_to_requests
from service.maps.schemas import CalibrationOrder, CalibrationReport

KIND = "calibrate"


def measured(
    map_: Map, encoder: Encoder, order: CalibrationOrder, encodings: Sequence[Encoding], advance: ProgressCallback
) -> CalibrationReport:
    """Ask a map, and report what follows; nothing is stored.

    Args:
        encodings: of the frames of the order's labels, in their order.

    Raises:
        UnknownPlace, UnknownSequence, CalibrationImpossible, StorageFailure.
        Others: what ``advance`` raises.
    """
    snapshot = map_.snapshot()
    queries = _queries(map_, snapshot, order, encodings)
    source = f"sequence:{order.sequence}" if order.method == "sequence" else order.method
    found = calibrate_map(map_, encoder, snapshot, queries, order.target, source, advance)
    return CalibrationReport(
        map=map_.record.id,
        encoder=encoder.identity,
        method=order.method,
        target=order.target,
        stored=not order.dry_run,
        calibration=found.calibration,
        previous=calibration_of(map_, encoder),
        measurement=found.measurement,
        warnings=calibration_warnings(found, order.method),
    )


def store(map_: Map, calibration: Calibration, replaces: Calibration | None, expected: int | None) -> None:
    """Make a calibration the map's, unless somebody has given it another one since it was asked for.

    Args:
        replaces: the one that the map had then; None: that of its encoder.
        expected: revision that the map must have; None: any.

    Raises:
        RevisionMismatch: the map's calibration, which is kept, is another one by now; or its revision is.
        StorageFull, StorageFailure.
    """
    while True:
        record = map_.record
        if record.calibration != replaces:
            raise RevisionMismatch("The map was given another calibration meanwhile; that one is kept.")
        try:
            map_.edit({"calibration": calibration}, record.revision if expected is None else expected)
        except RevisionMismatch:
            if expected is not None:
                raise
        else:
            return


def arguments_of(map_: Map, order: CalibrationOrder, expected: int | None) -> dict[str, Any]:
    """What the job is to know: the order, and what it may replace."""
    replaces = map_.record.calibration
    return order.model_dump(mode="json") | {
        "revision": expected,
        "replaces": None if replaces is None else replaces.model_dump(mode="json"),
    }


def calibrate(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Do what the job says; after a restart the map is asked anew, unless its calibration was stored already.

    Raises:
        UnknownMap, UnknownSequence, UnknownPlace, EncoderNotInstalled, CalibrationImpossible, RevisionMismatch,
            StorageFull, StorageFailure: the map has the calibration it had.
    """
    map_ = context.map(engine.atlas)
    wanted = dict(context.arguments)
    expected, replaces = wanted.pop("revision"), wanted.pop("replaces")
    order = CalibrationOrder.model_validate(wanted)
    if (noted := context.notes.get("report")) is not None:
        report = CalibrationReport.model_validate(noted)
        if map_.record.calibration == report.calibration:
            return report.model_dump(mode="json")  # killed between the commit and the end of the job

    def advance(done: int, total: int) -> None:
        context.progress(done, total)
        context.check_cancelled()
        if done % TOGETHER == 0:
            yield_to_requests(engine, context)

    report = measured(map_, engine.load_encoder(map_), order, [], advance)
    told = report.model_dump(mode="json")
    if not order.dry_run:
        context.remember(report=told)
        store(map_, report.calibration, None if replaces is None else Calibration.model_validate(replaces), expected)
    return told


def _queries(map_: Map, snapshot: Snapshot, order: CalibrationOrder, encodings: Sequence[Encoding]) -> LabelledQueries:
    if order.method == "frames":
        assert order.labels is not None
        return queries_from_labels(map_, snapshot, encodings, [label.place for label in order.labels])
    if order.method == "sequence":
        assert order.sequence is not None
        return queries_from_traverse(map_, snapshot, order.sequence, order.pairs, order.most)
    return queries_from_map(map_, snapshot, order.most)
