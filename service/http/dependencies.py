"""What routes ask for."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from typing import Annotated, Any, Protocol, Self, TypeVar

from fastapi import Depends, Header, Path, Query, Request
from pydantic import AfterValidator, Field

from core.errors import RevisionMismatch
from core.places import check_map_id, check_place_id
from core.storage import Map
from service.access.principals import Principal
from service.engine.engine import Engine
from service.engine.queue import RequestDeadline
from service.errors.faults import InvalidRequest, UnsupportedMediaType
from service.http.bodies import intake_of
from service.http.parameters import Parameters
from service.http.uploads import media_type, read_frame

JSON_TYPES = ("application/json", "application/merge-patch+json")


class FromState:
    """A dependency that gives what the application keeps under a name (see :mod:`service.app.runtime`)."""

    def __init__(self, name: str) -> None:
        self.name = name

    async def __call__(self, request: Request) -> Any:
        return getattr(request.app.state, self.name)


async def _principal(request: Request) -> Principal:
    principal: Principal = request.state.principal
    return principal


async def _request_deadline(
    request: Request,
    x_request_timeout: Annotated[
        float | None,
        Header(
            gt=0,
            le=3600,
            allow_inf_nan=False,
            description="Seconds, from its arrival, after which the request is to be dropped if its frame is not "
            "being encoded yet; at most the service's own limit.",
        ),
    ] = None,
) -> RequestDeadline:
    intake = intake_of(request)
    if x_request_timeout is not None:
        intake.deadline = min(intake.deadline, request.state.started + x_request_timeout)
    return RequestDeadline(intake.deadline, intake.hung_up)


async def single_values(request: Request) -> None:
    """Refuse a query parameter that is given twice: one of the two would be ignored.

    Raises:
        InvalidRequest: there is one.
    """
    seen: set[str] = set()
    for name, _ in request.query_params.multi_items():
        if name in seen:
            raise InvalidRequest(f"{name[:80]} stands in the query string twice.")
        seen.add(name)


async def json_body(request: Request) -> None:
    """Refuse a body that does not say it is JSON.

    Raises:
        UnsupportedMediaType: it does not.
    """
    kind = media_type(request)
    if kind not in JSON_TYPES:
        raise UnsupportedMediaType(f"The body is sent as {' or '.join(JSON_TYPES)}, not as {kind[:80] or 'nothing'}.")


class PageParameters(Parameters):
    """Which part of a listing."""

    cursor: str | None = Field(default=None, max_length=1024, description="next_cursor of the page before.")
    limit: int = Field(default=100, ge=1, le=1000, description="Most items of a page.")


class PlacePageParameters(PageParameters):
    """Which places."""

    sequence: str | None = Field(default=None, max_length=128, description="Only the places of this traverse.")


def expected_revision(if_match: str | None, current: int) -> int | None:
    """The revision that an edit insists on, None for any.

    Args:
        if_match: value of the If-Match header.
        current: the map's revision now.

    Raises:
        RevisionMismatch: the header names only other revisions.
    """
    if if_match is None or if_match.strip() == "*":
        return None
    strong = re.findall(r'(?<!W/)"([^"]*)"', if_match)
    if str(current) not in strong:
        raise RevisionMismatch(f"The map is at revision {current}; its ETag is {entity_tag(current)}.")
    return current


def entity_tag(revision: int) -> str:
    """The ETag of a map's revision."""
    return f'"{revision}"'


class FrameOptions(Protocol):
    """Parameters that stand beside one frame."""

    @property
    def encoder(self) -> str | None: ...
    def joined(self, fields: Mapping[str, str]) -> Self: ...


Options = TypeVar("Options", bound=FrameOptions)


async def frame_for_map(request: Request, engine: Engine, map_id: str, options: Options) -> tuple[Map, bytes, Options]:
    """What every route that takes one frame for a map begins with.

    Returns:
        The map, the bytes of the frame's file, and the parameters, those of a form's fields included.

    Raises:
        QueueFull: the encoder's queue is full, so the body is not read at all.
        UnknownMap, MapQuarantined, WrongEncoder.
        Others: as for ``read_frame``.
    """
    engine.queue.check_room()
    map_ = await engine.map(map_id)
    frame = await read_frame(request, engine.settings)
    options = options.joined(frame.fields)
    engine.assert_encoder(map_, options.encoder)
    return map_, frame.data, options


def started(request: Request) -> float:
    """When the request arrived (``time.monotonic``)."""
    moment: float = request.state.started
    return moment


def milliseconds_since(moment: float) -> float:
    """Milliseconds since ``moment`` (``time.monotonic``)."""
    return 1e3 * (time.monotonic() - moment)


def rounded(milliseconds: Mapping[str, float]) -> dict[str, float]:
    """Times as they are shown: to the microsecond."""
    return {stage: round(duration, 3) for stage, duration in milliseconds.items()}


EngineDep = Annotated[Engine, Depends(FromState("engine"))]
PrincipalDep = Annotated[Principal, Depends(_principal)]
DeadlineDep = Annotated[RequestDeadline, Depends(_request_deadline)]
MapId = Annotated[str, Path(alias="map", description="Id of the map.", examples=["lab"]), AfterValidator(check_map_id)]
PlaceId = Annotated[
    str, Path(alias="place", description="Id of the place.", examples=["p7"]), AfterValidator(check_place_id)
]
SequenceName = Annotated[str, Path(alias="sequence", description="Name of the traverse.", examples=["monday"])]
IfMatch = Annotated[
    str | None, Header(alias="If-Match", description="ETag of the map as it was read; 412 if it has changed since.")
]
Page = Annotated[PageParameters, Query()]
PlacePageQuery = Annotated[PlacePageParameters, Query()]
