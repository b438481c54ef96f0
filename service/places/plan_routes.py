"""The route of a map's plan: where all its places are, in columns, for drawing a hundred thousand of them."""

from __future__ import annotations

import gzip
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Depends, Query, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from service.errors.faults import PlanTooLarge
from service.errors.problems import problem_documentation
from service.http.headers import accepts_gzip, is_known
from service.http.routing import EngineDep, FromState, MapId, single_values
from service.http.schemas import Parameters
from service.places.plans import Plans
from service.worker_threads import in_thread

router = APIRouter(prefix="/v1/maps/{map}/plan", tags=["places"], dependencies=[Depends(single_values)])

PLAN_EXAMPLE: dict[str, Any] = {
    "map": "lab",
    "revision": "5c0f2b6a39d1e7784f1f8f6f0c1a2b3d",
    "places": 3,
    "step": 1,
    "sequences": ["monday"],
    "ids": ["p0", "p1", "p2"],
    "sequence": [0, 0, -1],
    "x": [0.0, 1.5, None],
    "y": [0.0, 2.0, None],
    "z": None,
    "latitude": None,
    "longitude": None,
    "heading": [90.0, 90.0, None],
    "timestamp": [1795168800000, 1795168801000, None],
    "flags": [2, 3, 0],
    "gaps": [{"before": "p0", "after": "p1", "metres": 2.5}],
    "gap_count": 1,
}

Numbers = list[float | None] | None


class PlanParameters(Parameters):
    """How many of the places."""

    step: int = Field(default=1, ge=1, le=1_000_000, description="List about one place in every `step`.")


class PlannedGap(BaseModel):
    """Two successive places of a traverse that are unusually far apart."""

    before: str
    after: str
    metres: float


class PlanView(BaseModel):
    """Where the places of a map are: columns of equal length, in the order of enrolment.

    A column in which no place has a value is null.
    """

    model_config = ConfigDict(json_schema_extra={"examples": [PLAN_EXAMPLE]})

    map: str
    revision: str = Field(description="Names the content: the same places have the same one. It is in the ETag.")
    places: int = Field(description="How many places the map has.")
    step: int
    sequences: list[str] = Field(description="The names of the traverses.")
    ids: list[str]
    sequence: list[int] = Field(description="The traverse of each place, an index into `sequences`; -1: none.")
    x: Numbers = Field(description="Metres, to the millimetre.")
    y: Numbers
    z: Numbers
    latitude: Numbers = Field(description="Degrees, to 1e-7.")
    longitude: Numbers
    heading: Numbers = Field(description="Degrees, to 0.01.")
    timestamp: list[int | None] | None = Field(description="Milliseconds since 1970 (UTC).")
    flags: list[int] = Field(
        description="The sum of 1, if the pose was handed over by an alignment, and 2, if a picture is stored."
    )
    gaps: list[PlannedGap] = Field(description="The gaps in metres of the health report, longest first; 500 at most.")
    gap_count: int = Field(description="How many gaps in metres there are.")


@router.get(
    "",
    response_model=PlanView,
    responses={
        304: {"description": "The plan is the one whose ETag `If-None-Match` names."},
        **problem_documentation(PlanTooLarge),
    },
)
async def read_plan(
    map_id: MapId,
    options: Annotated[PlanParameters, Query()],
    request: Request,
    engine: EngineDep,
    plans: Annotated[Plans, Depends(FromState("plans"))],
) -> Response:
    """Read where all places of a map are, in columns; made for drawing a hundred thousand of them.

    The plan is cached until a write to the map. Send its ETag as `If-None-Match`: the answer is 304 while no place has
    changed. It is compressed for callers that accept gzip. At most 200 000 places are listed; of a larger map ask for
    every n-th by `step`.
    """
    map_ = await engine.map(map_id)
    plan = plans.cached(map_, options.step)
    if plan is None:
        plan = await to_thread.run_sync(plans.make, map_, options.step, limiter=plans.one_at_a_time)
    headers = {"ETag": f'W/"{plan.revision}"', "Cache-Control": "private, no-cache", "Vary": "Accept-Encoding"}
    if is_known(request.headers, plan.revision):
        return Response(status_code=304, headers=headers)
    if accepts_gzip(request.headers.get("accept-encoding")):
        return Response(plan.compressed, media_type="application/json", headers=headers | {"Content-Encoding": "gzip"})
    return Response(await in_thread(gzip.decompress, plan.compressed), media_type="application/json", headers=headers)
