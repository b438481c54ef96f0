"""The route that reads a map's calibration, its measurements, and the effect of another threshold."""

from __future__ import annotations

import json
import logging
from datetime import datetime
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Response
from pydantic import BaseModel, Field

from core import errors
from core.judgement.calibration import Effect, Kinds, effect_of
from core.judgement.trials import Trials
from core.judgement.verdict import Calibration
from core.places import Timestamp
from core.recognition.calibration import one_sided
from core.store import Map
from service.errors.problems import problem_documentation
from service.http.headers import entity_tag
from service.http.routing import EngineDep, MapId, single_values
from service.http.schemas import Parameters
from service.maps.schemas import MOST_FRAMES, CalibrationReport
from service.queries.answers import StatisticsDep
from service.queries.statistics import QueryStatistics, map_key
from service.review.labels import known_frames

log = logging.getLogger("placerec.calibration")

router = APIRouter(prefix="/v1/maps/{map}/calibration", tags=["calibration"], dependencies=[Depends(single_values)])


class PreviewParameters(Parameters):
    """The calibration to compare with the one in force."""

    threshold: float | None = Field(
        default=None, allow_inf_nan=False, description="Another threshold on the decision value.", examples=[0.12]
    )
    margin: float | None = Field(default=None, ge=0, allow_inf_nan=False, description="Another margin.")


class LatestMeasurement(BaseModel):
    """The latest calibrate of a map, a dry run or not."""

    at: Timestamp
    report: CalibrationReport


class CalibrationState(BaseModel):
    """A map's calibration, and its effect on the frames of the latest calibrate."""

    map: str
    revision: int = Field(description="Of the map's settings; the ETag contains it.")
    calibration: Calibration | None = Field(description="The one in force; null if the encoder is not installed.")
    measured: LatestMeasurement | None = Field(description="Null if nothing was measured, or it is not known any more.")
    now: Effect | None = Field(description="The effect of the calibration in force on the frames that were measured.")
    then: Effect | None = Field(description="Its effect with the threshold and the margin that were given.")
    proposed: Effect | None = Field(
        description="The effect of the calibration that was measured, which a dry run has found and not stored."
    )


@router.get("", responses=problem_documentation(errors.StorageFull))
def read_calibration(
    map_id: MapId,
    options: Annotated[PreviewParameters, Query()],
    engine: EngineDep,
    statistics: StatisticsDep,
    response: Response,
) -> CalibrationState:
    """Read a map's calibration, the reliability and the curves that were measured for it, and preview a threshold.

    The frames are those of the latest calibrate, which are not queried again. To apply a threshold, send it by PATCH to
    the map with this answer's ETag as `If-Match`.
    """
    map_ = engine.maps.get(map_id)
    record = map_.record
    in_force = record.calibration or engine.default_calibration(record.encoder)
    response.headers["ETag"] = entity_tag(record.revision)
    found = measured_of(statistics.calibration(map_key(map_)))
    now = then = proposed = None
    if found is not None and not found[0].report.stored:
        proposed = effect_of(found[1], found[0].report.calibration)
    if in_force is not None and found is not None:
        trials, changes = found[1], options.model_dump(exclude_none=True)
        now = effect_of(trials, in_force)
        then = effect_of(trials, in_force.model_copy(update=changes)) if changes else None
    return CalibrationState(
        map=map_id,
        revision=record.revision,
        calibration=in_force,
        measured=None if found is None else found[0],
        now=now,
        then=then,
        proposed=proposed,
    )


def measured_of(stored: tuple[datetime, str, str] | None) -> tuple[LatestMeasurement, Trials] | None:
    """The measurement and its trials; None if there is none that this version can read."""
    if stored is None:
        return None
    at, report, trials = stored
    try:
        return (
            LatestMeasurement(at=at, report=CalibrationReport.model_validate_json(report)),
            Trials.of_record(json.loads(trials)),
        )
    except (KeyError, TypeError, ValueError) as error:
        log.warning("what was measured in calibrating a map cannot be read: %s", error)
        return None


def storable(report: CalibrationReport) -> Calibration:
    """The calibration that was measured, if it may become the map's own: the one judge of all that were fitted.

    Raises:
        CalibrationWorse: held-out answers speak against it.
    """
    if report.change is not None and report.change.worse is not None:
        raise errors.CalibrationWorse(
            f"{report.change.worse} The map keeps its calibration. Give more frames, of known places and of strangers; "
            "a dry run shows these figures."
        )
    return report.calibration


def calibration_doubt(statistics: QueryStatistics, map_: Map) -> str | None:
    """Why a map's own calibration is not to be trusted: it rests on frames of one kind, or on too few of one.

    Which frames it rests on is known from the latest measurement, if it was stored, or from the labels of the review.

    Returns:
        A sentence; None if the map has none of its own, or nothing is known against it.
    """
    own = map_.record.calibration
    if own is None:
        return None
    try:
        found = measured_of(statistics.calibration(map_key(map_)))
        report = None if found is None else found[0].report
        if report is not None and report.calibration.curve == own.curve:
            kinds = Kinds(report.measurement.known, report.measurement.unknown)
        elif own.source == "labels":
            places = [frame.place for frame in known_frames(map_, MOST_FRAMES)[0]]
            kinds = Kinds(len(places) - places.count(None), places.count(None))
        else:
            return None
    except errors.PlacerecError as error:
        log.warning("what the calibration of %s rests on cannot be read: %s", map_.record.id, error)
        return None
    return one_sided(kinds)
