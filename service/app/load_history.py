"""The route of the history of the service's load, for plots."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query
from pydantic import BaseModel, ConfigDict, Field

from core import errors
from core.places import Timestamp
from service.app.runtime import Runtime
from service.errors.problems import problem_documentation
from service.http.routing import FromState, single_values
from service.http.schemas import Parameters
from service.telemetry.history import MINUTES

RuntimeDep = Annotated[Runtime, Depends(FromState("runtime"))]

router = APIRouter(prefix="/v1/service/history", tags=["service"], dependencies=[Depends(single_values)])

HISTORY_EXAMPLE: dict[str, Any] = {
    "step_seconds": 60,
    "at": ["2026-11-22T18:01:00Z", "2026-11-22T18:02:00Z"],
    "recognized": [118, 112],
    "ambiguous": [2, 1],
    "unknown": [0, 7],
    "requests": [120, 120],
    "errors": [0, 0],
    "p50": [21.2, 21.0],
    "p99": [40.1, 39.6],
    "resident": [812646400, 812646400],
    "disk_free": [52613349376, 52613349376],
    "disk_total": [105089261568, 105089261568],
}


class LoadView(BaseModel):
    """The load over time in columns: one entry of each for every step in which the service ran."""

    model_config = ConfigDict(json_schema_extra={"examples": [HISTORY_EXAMPLE]})

    step_seconds: int = Field(description="The length of a step; longer for a longer time.")
    at: list[Timestamp] = Field(description="When the step began.")
    recognized: list[int] = Field(description="Answers with this verdict, to all callers.")
    ambiguous: list[int]
    unknown: list[int]
    requests: list[int] = Field(
        description="Requests that asked where frames were taken, without those of the console and without the frames "
        "of WebSockets."
    )
    errors: list[int] = Field(description="Those of them that were answered with a status of 500 or more.")
    p50: list[float | None] = Field(description="Milliseconds of such a request: the mean of the minutes' medians.")
    p99: list[float | None] = Field(description="The longest of the minutes' 99th percentiles.")
    resident: list[int | None] = Field(description="Bytes of memory of all services together.")
    disk_free: list[int | None] = Field(description="Free bytes of the disk that has least room.")
    disk_total: list[int | None]


class HistoryParameters(Parameters):
    """How far to look back."""

    hours: float = Field(default=24.0, ge=1 / 60, le=MINUTES / 60, description="Hours until now.")


@router.get("", responses=problem_documentation(errors.StorageFull))
def read_history(options: Annotated[HistoryParameters, Query()], runtime: RuntimeDep) -> LoadView:
    """Read how many answers the service gave in each minute of the last days, and its latencies, memory and disk.

    The history is stored for a week; Prometheus can keep it for longer.
    """
    step, points = runtime.history.read(max(1, round(60 * options.hours)))
    names = [name for name in LoadView.model_fields if name not in ("step_seconds", "at")]
    columns = {name: [getattr(one, name) for one in points] for name in names}
    at = [datetime.fromtimestamp(60 * one.minute, UTC) for one in points]
    return LoadView(step_seconds=60 * step, at=at, **columns)
