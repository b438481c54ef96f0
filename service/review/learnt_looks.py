"""The looks and places that a map has learnt from a run are removed: what it taught is undone."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from pydantic import BaseModel, Field

from core import errors
from core.places import Timestamp
from service.errors.faults import InvalidRequest
from service.errors.problems import problem_documentation
from service.http.routing import WHOLE_DELETION, EngineDep, MapId, StrictRoute, single_values
from service.places.looks import Run
from service.places.place_events import tell_change
from service.queries.answers import StatisticsDep
from service.queries.statistics import map_key

router = APIRouter(
    prefix="/v1/maps/{map}", tags=["places"], route_class=StrictRoute, dependencies=[Depends(single_values)]
)


class RemovedLooks(BaseModel):
    """Looks and places of one run that were removed together."""

    run: str | None = Field(description="The run from which they were learnt; null: any.")
    since: Timestamp | None = Field(description="Only those that were added from then on; null: all before, too.")
    until: Timestamp | None = Field(description="Only those that were added before; null: all after, too.")
    looks: int = Field(ge=0, description="How many there were.")
    places: int = Field(ge=0, description="How many places of new ground there were.")


@router.delete("/looks", dependencies=[WHOLE_DELETION], responses=problem_documentation(errors.StorageFull))
def delete_learnt_looks(
    map_id: MapId,
    request: Request,
    engine: EngineDep,
    statistics: StatisticsDep,
    run: Annotated[Run | None, Query(description="Those that were learnt from this run.")] = None,
    since: Annotated[
        Timestamp | None,
        Query(
            description="Those that were added to the map at this time or later (ISO 8601; UTC without a zone).",
            examples=["2026-11-20T22:00:00Z"],
        ),
    ] = None,
    until: Annotated[Timestamp | None, Query(description="Those that were added before this time.")] = None,
) -> RemovedLooks:
    """Remove the looks that were learnt from one run, or in a period, or both, in one commit.

    Looks that people added by hand stay.  With a run and no period its places of new ground go too, in another commit,
    and so do the answers of the run by which the map calibrates itself; a calibration that is stored stays.
    """
    if run is None and since is None and until is None:
        raise InvalidRequest("Give run, since or until: without them all learnt looks would go.")
    map_ = engine.maps.get(map_id)
    looks = map_.forget_learnt(run, since, until)
    places = 0
    if run is not None and since is None and until is None:
        places = map_.forget_new_ground(run)
        statistics.forget_run_trials(map_key(map_), run)
    removed = RemovedLooks(run=run, since=since, until=until, looks=looks, places=places)
    request.state.noted = {"map": map_id, **removed.model_dump(mode="json", exclude_none=True)}
    tell_change(engine, map_, "look-removed", looks)
    tell_change(engine, map_, "deleted", places)
    return removed
