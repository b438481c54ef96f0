"""A map calibrates itself: by the frames of a run whose place the rest of the run knows beyond doubt, and by a traverse
of its own that was aligned with others.

What they would change is measured as by a dry run of ``calibrate``, for a person to store; or, by the map's setting
``learning.calibration``, it is stored, in the case of runs once two independent ones tell it.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

from core.errors import CalibrationImpossible, CalibrationWorse, PlacerecError, RevisionMismatch
from core.judgement.calibration import effect_of
from core.judgement.reliability import reliability
from core.judgement.trials import StagedTrials, Trials
from core.learning import count_witnesses
from core.store import Map
from service.engine.engine import Engine
from service.jobs.context import JobCancelled, JobContext, progress_of
from service.learning.run_notes import RunNotes
from service.maps.calibration import ALIGNED, RUNS, by_itself, measure, remember, store
from service.maps.calibration_preview import measured_of, storable
from service.maps.schemas import CalibrationOrder, CalibrationReport
from service.places.map_events import tell_map
from service.queries.histories.run_trials import RunTrials
from service.queries.statistics import QueryStatistics, map_key

WITNESSES = 2
"""From so many independent runs trials have to be for a map to calibrate itself."""

LEAST_FRAMES = 30
"""From fewer frames nothing is proposed: on 17 of a corridor by night, the threshold would follow chance."""

PRECEDENCE = timedelta(days=1)
"""For so long a person's dry run stays, and no proposal takes its place."""


def calibrate_by_run(
    engine: Engine, statistics: QueryStatistics, map_: Map, notes: RunNotes, trials: StagedTrials
) -> Mapping[str, Any]:
    """Store what a run says of a map's answers, and propose, or store, the calibration that follows from its runs.

    Args:
        trials: the answers to the frames of the run that it is certain of, at least one.

    Returns:
        JSON: how many ``frames`` of how many ``runs`` there are by now, and what :func:`_offered` says.

    Raises:
        EncoderNotInstalled, StorageFull, StorageFailure: the map keeps its calibration.
    """
    key = map_key(map_)
    statistics.keep_run_trials(key, RunTrials(notes.session, notes.source, trials))
    ran, encoder = statistics.run_trials(key), engine.load_encoder(map_)
    told: dict[str, Any] = {"frames": sum(one.frames for one in ran), "runs": len({one.run for one in ran})}
    if told["frames"] < LEAST_FRAMES:
        return told | {"outcome": "too few"}
    order = CalibrationOrder(method=RUNS, dry_run=True)
    try:
        found = measure(map_, encoder, order, [], lambda _done, _total: None, ran=ran)
    except CalibrationImpossible as error:
        return told | {"outcome": "impossible", "detail": str(error)}
    return told | _offered(engine, statistics, map_, *found, count_witnesses(one.source for one in ran) >= WITNESSES)


def calibrate_by_traverse(
    engine: Engine, statistics: QueryStatistics, context: JobContext, sequence: str
) -> Mapping[str, Any] | None:
    """Propose, or store, the calibration that follows from a traverse of the job's map, which was just aligned.

    What was aligned is stored already, so no failure here is one of the job.

    Returns:
        JSON: how many ``frames`` were asked, and what :func:`_offered` says; None if the map is not to calibrate
        itself.  The ``outcome`` is ``impossible`` where an error stands in the way, the ``detail``, and ``cancelled``
        if the job was.

    Raises:
        JobInterrupted: the map keeps its calibration.
    """
    try:
        map_ = context.map(engine.maps)
        if map_.record.learning.calibration == "off":
            return None
        order = CalibrationOrder(method="sequence", sequence=sequence, dry_run=True)
        advance = progress_of(engine, context, "asking the map its own frames")
        report, asked = measure(map_, engine.load_encoder(map_), order, [], advance)
        told: dict[str, Any] = {"frames": report.measurement.frames}
        if told["frames"] < LEAST_FRAMES:
            return told | {"outcome": "too few"}
        named = report.calibration.model_copy(update={"source": ALIGNED + sequence})
        report = report.model_copy(update={"calibration": named})
        return told | _offered(engine, statistics, map_, report, asked, witnessed=True)
    except PlacerecError as error:
        return {"outcome": "impossible", "detail": str(error)}
    except JobCancelled:
        return {"outcome": "cancelled"}


def _offered(
    engine: Engine, statistics: QueryStatistics, map_: Map, report: CalibrationReport, asked: Trials, witnessed: bool
) -> dict[str, Any]:
    """Propose a calibration that was measured, or store it, as the map's setting says.

    Args:
        asked: the answers that it rests on.
        witnessed: whether enough speaks for it to be stored without a person.

    Returns:
        JSON: the ``outcome``: ``stored``, ``proposed`` or ``holds`` (the calibration in force is no worse); and the
        calibration ``error``, the ``recall`` and the ``precision`` before and after, the latter cross-validated.

    Raises:
        StorageFull, StorageFailure: the map keeps its calibration.
    """
    before = reliability(asked.probabilities(report.previous), asked.right) if report.previous.curve else None
    after = report.measurement.cross_validated.reliability
    now, then = effect_of(asked, report.previous), report.measurement.cross_validated
    told: dict[str, Any] = {
        "error": [_rounded(None if before is None else before.ece), _rounded(after.ece)],
        "recall": [_rounded(now.recall.value), _rounded(then.recall.value)],
        "precision": [_rounded(now.precision.value), _rounded(then.precision.value)],
    }
    if before is not None and after.brier >= before.brier:
        return told | {"outcome": "holds"}
    try:
        found = storable(report)
    except CalibrationWorse as error:
        return told | {"outcome": "holds", "detail": str(error)}
    replaces = map_.record.calibration
    by_person = replaces is not None and not by_itself(replaces)
    if map_.record.learning.calibration == "auto" and not by_person and witnessed:
        report = report.model_copy(update={"stored": True})
        try:
            store(map_, found, replaces, None)
        except RevisionMismatch:
            return told | {"outcome": "holds"}
        remember(statistics, map_, report, asked)
        tell_map(engine, map_, "calibrated")
        return told | {"outcome": "stored"}
    if not _waits(statistics, map_):
        remember(statistics, map_, report, asked)
    return told | {"outcome": "proposed"}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def _waits(statistics: QueryStatistics, map_: Map) -> bool:
    """Whether a person has just measured a calibration, and has not stored it yet."""
    found = measured_of(statistics.calibration(map_key(map_)))
    if found is None:
        return False
    report = found[0].report
    recent = datetime.now(UTC) - found[0].at < PRECEDENCE
    return recent and not report.stored and not by_itself(report.calibration)
