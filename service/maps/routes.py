"""Routes that create, list, read, edit, delete and verify maps."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Depends, Query, Request, Response

from core import errors
from core.judgement.verdict import Calibration
from core.maps import AlarmSetting, LearningSetting, MapRecord, MapSettings, ReviewSetting, VerifyReport
from core.maps.pagination import Listing, decode_name, page_of
from core.places import check_map_id
from core.store import Map
from service.engine.engine import Engine
from service.errors.faults import BodyTooLarge, JobQueueFull, MalformedBody, TooManyMaps, UnsupportedMediaType
from service.errors.problems import problem_documentation
from service.http.headers import entity_tag, expected_revision
from service.http.openapi import json_patch
from service.http.routing import (
    WHOLE_DELETION,
    EngineDep,
    IfMatch,
    MapId,
    Page,
    PrincipalDep,
    StrictRoute,
    json_body,
    single_values,
)
from service.http.schemas import PageParameters
from service.jobs.routes import JobsDep, accepted
from service.jobs.schemas import JobView
from service.maps import storage_jobs
from service.maps.calibration_preview import calibration_doubt, measured_of, storable
from service.maps.limits import check_map_count
from service.maps.schemas import (
    AlarmChanges,
    CalibrationChanges,
    LearningChanges,
    MapChanges,
    MapPage,
    MapView,
    NewMap,
    QuarantinedMap,
    ReviewChanges,
)
from service.places.map_events import tell_end, tell_map
from service.queries.answers import StatisticsDep
from service.queries.counts import VerdictCounts
from service.queries.given_answers import MapKey
from service.queries.statistics import QueryStatistics, map_key
from service.recordings.routes import RecordingsDep

router = APIRouter(
    prefix="/v1/maps",
    tags=["maps"],
    route_class=StrictRoute,
    dependencies=[Depends(single_values)],
    responses=problem_documentation(errors.StorageFailure, errors.MapQuarantined),
)
log = logging.getLogger("placerec.maps")

Setting = TypeVar("Setting", ReviewSetting, LearningSetting, AlarmSetting)

ALL_MAPS = "(all)"
"""The lock held while a map is created, so that two requests cannot both create the last map that is allowed; no map
can have this id."""

BODY_PROBLEMS = (MalformedBody, BodyTooLarge, UnsupportedMediaType)


def show_map(
    engine: Engine, statistics: QueryStatistics, map_: Map, last_day: Mapping[MapKey, VerdictCounts] | None
) -> MapView:
    """A map as JSON.

    Args:
        last_day: the answers of the last day by map; None if they are not known.
    """
    record = map_.record
    calibration = record.calibration or engine.default_calibration(record.encoder)
    return MapView(
        **record.model_dump(exclude={"calibration", "index", "precision", "review"}),
        review=record.review,
        calibration=calibration,
        calibration_doubt=calibration_doubt(statistics, map_),
        index=map_.index_status(),
        storage=map_.storage_status(),
        places=map_.count_places(),
        last_day=None if last_day is None else last_day.get(map_key(map_), VerdictCounts()),
    )


def _last_day(statistics: QueryStatistics, map_: Map | None = None) -> Mapping[MapKey, VerdictCounts] | None:
    """The answers of the last day, of one map or of all; None if the disk refuses, which hides no map."""
    try:
        return statistics.last_day(None if map_ is None else map_key(map_))
    except errors.PlacerecError as error:
        log.warning("the statistics of queries cannot be read: %s", error)
        return None


@router.post(
    "",
    status_code=201,
    dependencies=[Depends(json_body)],
    responses=problem_documentation(
        *BODY_PROBLEMS,
        errors.MapExists,
        TooManyMaps,
        errors.InvalidIdentifier,
        errors.UnknownEncoder,
        errors.StorageFull,
    ),
)
def create_map(
    new: NewMap,
    request: Request,
    engine: EngineDep,
    statistics: StatisticsDep,
    principal: PrincipalDep,
    response: Response,
) -> MapView:
    """Create a map, bound for life to one encoder."""
    check_map_id(new.id)
    request.state.noted = {"map": new.id}
    principal.require(new.id)
    identity = engine.resolve(new.encoder)
    encoder = engine.catalogue.summary(identity)
    settings = MapSettings(**new.model_dump(exclude={"id", "encoder", "precision"}))
    with engine.writing(ALL_MAPS):
        check_map_count(engine)
        map_ = engine.maps.create(
            new.id, identity, encoder.dimension, settings, encoder.local_shape, precision=new.precision
        )
    map_.open()
    response.headers["ETag"] = entity_tag(map_.record.revision)
    response.headers["Location"] = f"{engine.settings.root_path}{router.prefix}/{new.id}"
    return show_map(engine, statistics, map_, _last_day(statistics, map_))


@router.get("", responses=problem_documentation(errors.InvalidCursor))
def list_maps(page: Page, engine: EngineDep, statistics: StatisticsDep, principal: PrincipalDep) -> MapPage:
    """List the maps in the order of their ids, and the damaged maps; a key limited to some maps sees only those."""
    if principal.maps is None:
        records, next_cursor = engine.maps.records(page.cursor, page.limit)
    else:
        records, next_cursor = _records_among(engine, principal.maps, page)
    items, last_day = [], _last_day(statistics)
    for record in records:
        try:
            items.append(show_map(engine, statistics, engine.maps.find(record.id), last_day))
        except (errors.UnknownMap, errors.MapQuarantined):
            continue  # it was deleted or found to be damaged since it was listed
    damaged = engine.maps.quarantined().items()
    quarantined = [QuarantinedMap(id=name, reason=reason) for name, reason in damaged if principal.may_use(name)]
    return MapPage(items=items, next_cursor=next_cursor, quarantined=quarantined)


def _records_among(engine: Engine, map_ids: frozenset[str], page: PageParameters) -> tuple[list[MapRecord], str | None]:
    """A page of these maps alone, and its cursor, which does not reveal other maps either."""
    listing: Listing = ["maps-among", *sorted(map_ids)]
    found = []
    for map_id in sorted(map_ids):
        with suppress(errors.UnknownMap, errors.MapQuarantined):
            found += [engine.maps.find(map_id).record] if map_id > decode_name(listing, page.cursor) else []
    return page_of(listing, found, page.limit, lambda record: record.id)


@router.get("/{map}", responses=problem_documentation(errors.UnknownMap))
def read_map(map_id: MapId, engine: EngineDep, statistics: StatisticsDep, response: Response) -> MapView:
    """Read a map's settings, calibration and size; send its ETag as `If-Match` when you edit the map."""
    map_ = engine.maps.get(map_id)
    response.headers["ETag"] = entity_tag(map_.record.revision)
    return show_map(engine, statistics, map_, _last_day(statistics, map_))


@router.patch(
    "/{map}",
    dependencies=[Depends(json_body)],
    openapi_extra=json_patch(MapChanges),
    responses=problem_documentation(
        *BODY_PROBLEMS,
        errors.UnknownMap,
        errors.RevisionMismatch,
        errors.InvalidField,
        errors.CalibrationWorse,
        errors.StorageFull,
    ),
)
def edit_map(
    map_id: MapId,
    changes: MapChanges,
    engine: EngineDep,
    statistics: StatisticsDep,
    response: Response,
    if_match: IfMatch = None,
) -> MapView:
    """Edit a map by a merge patch.

    A calibration that is set here becomes the map's own (`"source": "manual"`); values that are left out are those
    of the calibration in force. `null` restores the encoder's default. With `measured_at` it is the one that the latest
    calibrate has found, and with `restore` one that the map had before, whole.
    """
    map_ = engine.maps.get(map_id)
    expected = expected_revision(if_match, map_.record.revision)
    settings = _settings_changes(engine, statistics, map_, changes)
    edited = map_.edit(settings, expected)
    tell_map(engine, map_, "edited", sorted(settings))
    if edited.review is not None and "review" in settings:
        try:
            map_.review.shrink(edited.review)
        except errors.PlacerecError as error:  # the map is edited; the next frame that is stored shrinks it again
            log.warning("frames stored beyond the new limits stay for now: %s", error, extra={"map": map_id})
    response.headers["ETag"] = entity_tag(edited.revision)
    return show_map(engine, statistics, map_, _last_day(statistics, map_))


def _settings_changes(engine: Engine, statistics: QueryStatistics, map_: Map, changes: MapChanges) -> dict[str, Any]:
    """The values that a merge patch sets; null stands for the default of its field.

    Raises:
        InvalidField, RevisionMismatch, CalibrationWorse.
    """
    defaults = MapSettings()
    given = {name: getattr(changes, name) for name in changes.model_fields_set}
    calibration, review = given.pop("calibration", None), given.pop("review", None)
    learning, alarms = given.pop("learning", None), given.pop("alarms", None)
    values = {name: getattr(defaults, name) if value is None else value for name, value in given.items()}
    if "calibration" in changes.model_fields_set:
        measured_at = None if calibration is None else calibration.measured_at
        values["calibration"] = (
            _own_calibration(engine, map_, calibration)
            if measured_at is None
            else _measured_calibration(statistics, map_, measured_at)
        )
    if "review" in changes.model_fields_set:
        kept = map_.record.review or ReviewSetting()
        values["review"] = None if review is None else _changed(kept, ReviewSetting(), review)
    if "learning" in changes.model_fields_set:
        off = LearningSetting()
        values["learning"] = off if learning is None else _changed(map_.record.learning, off, learning)
    if "alarms" in changes.model_fields_set:
        silent = AlarmSetting()
        values["alarms"] = silent if alarms is None else _changed(map_.record.alarms, silent, alarms)
    return values


def _changed(now: Setting, default: Setting, changes: ReviewChanges | LearningChanges | AlarmChanges) -> Setting:
    """A setting of several values after a merge patch; null stands for the default of a value."""
    given = {name: getattr(changes, name) for name in changes.model_fields_set}
    changed = {name: getattr(default, name) if value is None else value for name, value in given.items()}
    return type(now)(**now.model_dump() | changed)


def _measured_calibration(statistics: QueryStatistics, map_: Map, at: datetime) -> Calibration:
    """The calibration that the latest calibrate of a map has found, at this time.

    Raises:
        RevisionMismatch: it was measured at another time, or nothing was.
        CalibrationWorse: held-out answers speak against it.
    """
    found = measured_of(statistics.calibration(map_key(map_)))
    if found is None or found[0].at != at or found[0].report.encoder != map_.record.encoder:
        raise errors.RevisionMismatch("The map was measured again meanwhile; read its calibration again.")
    return storable(found[0].report)


def _own_calibration(engine: Engine, map_: Map, changes: CalibrationChanges | None) -> Calibration | None:
    if changes is None:
        return None
    if changes.restore is not None:
        return changes.restore
    record = map_.record
    default = engine.default_calibration(record.encoder)
    base = record.calibration or default
    if base is None:
        raise errors.InvalidField(f"The encoder {record.encoder} is not installed, so its calibration is not known.")
    values = base.model_dump() | {"source": "manual"}
    for name in changes.model_fields_set & {"threshold", "margin"}:
        value = getattr(changes, name)
        values[name] = getattr(default or base, name) if value is None else value
    return Calibration(**values)


@router.delete(
    "/{map}",
    status_code=204,
    dependencies=[WHOLE_DELETION],
    responses=problem_documentation(errors.UnknownMap, errors.RevisionMismatch, errors.StorageFailure),
)
def delete_map(map_id: MapId, engine: EngineDep, recordings: RecordingsDep, if_match: IfMatch = None) -> None:
    """Delete a map with everything that it contains. A damaged map can be deleted, too."""
    if if_match is not None:
        expected_revision(if_match, engine.maps.find(map_id).record.revision)
    engine.maps.delete(map_id)
    recordings.forget_map(map_id)
    engine.metrics.forget_map(map_id)
    tell_end(engine, map_id)


@router.post(
    "/{map}/verify",
    response_model=VerifyReport,
    responses={
        202: {"model": JobView, "description": "The job that verifies the map, if `background` is true."},
        **problem_documentation(errors.UnknownMap, JobQueueFull, errors.StorageFull),
    },
)
def verify_map(
    map_id: MapId,
    engine: EngineDep,
    jobs: JobsDep,
    background: Annotated[
        bool, Query(description="Answer 202 with a job; its result is the report. A large map takes minutes.")
    ] = False,
) -> VerifyReport | Response:
    """Read all of a map, which may be damaged, and compare it with its checksums."""
    if not background:
        return engine.maps.verify(map_id)
    job = jobs.submit(storage_jobs.VERIFY, map_id, arguments={}, maps=storage_jobs.creation_times(engine, map_id))
    return accepted(job, engine.settings)
