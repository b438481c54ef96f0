"""The route of a map's coverage."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query

from core import errors
from service.errors.problems import problem_documentation
from service.http.routing import EngineDep, MapId, single_values
from service.poses.coverage import CoverageParameters, CoverageView, coverage_of
from service.worker_threads import in_thread

router = APIRouter(prefix="/v1/maps/{map}/coverage", tags=["places"], dependencies=[Depends(single_values)])


@router.get("", responses=problem_documentation(errors.MixedCoordinates))
async def check_coverage(
    map_id: MapId, options: Annotated[CoverageParameters, Query()], engine: EngineDep
) -> CoverageView:
    """Check whether a pose is in a map, and how well: what is around it, and the nearest places.

    Give `x` and `y`, or `latitude` and `longitude`, and `heading` if places that look elsewhere are not to count. No
    frame is needed: plan a drive with it, or see where to record more.
    """
    return await in_thread(coverage_of, await engine.map(map_id), options)
