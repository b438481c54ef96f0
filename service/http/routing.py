"""The parts of routes: their dependencies, the first steps of a route that takes a frame, and strict JSON bodies."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Coroutine, Mapping
from functools import wraps
from typing import Annotated, Any, Protocol, Self, TypeVar

from fastapi import Depends, Header, Path, Query, Request
from fastapi.routing import APIRoute
from pydantic import AfterValidator
from starlette.responses import Response

from core.numerals import Decimal
from core.places import check_map_id, check_place_id, check_sequence
from core.store import Map
from service.access.roles import Principal
from service.engine.engine import Engine
from service.engine.queue import RequestDeadline
from service.errors.faults import InvalidRequest, UnsupportedMediaType
from service.http.bodies import intake_of, json_size, parse_json
from service.http.schemas import PageParameters
from service.http.uploads import instead_of, media_type, read_frame
from service.worker_threads import in_thread

JSON_TYPES = ("application/json", "application/merge-patch+json")


class FromState:
    """A dependency that gives an object of the application by its name (see :mod:`service.app.runtime`)."""

    def __init__(self, name: str) -> None:
        self.name = name

    async def __call__(self, request: Request) -> Any:
        return getattr(request.app.state, self.name)


async def _whole_deletion(request: Request) -> None:
    """Refuse a deletion that says more than its path: a caller that says more means to delete less.

    Raises:
        InvalidRequest: the query string has a parameter that the operation does not know, or there is a body.
    """
    known = {one.alias for one in request.scope["route"].dependant.query_params}
    if unknown := [name for name in request.query_params if name not in known]:
        raise InvalidRequest(f"query.{unknown[0][:80]}: A deletion takes no such parameter; nothing was deleted.")
    if await request.body():
        raise InvalidRequest("A deletion takes no body; nothing was deleted.")


WHOLE_DELETION = Depends(_whole_deletion)
"""The dependencies of every DELETE."""


async def _principal(request: Request) -> Principal:
    principal: Principal = request.state.principal
    return principal


async def _request_deadline(
    request: Request,
    x_request_timeout: Annotated[
        Decimal | None,
        Header(
            gt=0,
            le=3600,
            allow_inf_nan=False,
            description="Seconds after which the request is dropped if its frame is not being encoded yet; at most the "
            "service's own limit.",
        ),
    ] = None,
) -> RequestDeadline:
    intake = intake_of(request)
    if x_request_timeout is not None:
        intake.deadline = min(intake.deadline, request.state.started + x_request_timeout)
    return RequestDeadline(intake.deadline, intake.hung_up)


async def single_values(request: Request) -> None:
    """Refuse a query parameter that is given twice, since one of the two would be ignored.

    Raises:
        InvalidRequest: a parameter is given twice.
    """
    seen: set[str] = set()
    for name, _ in request.query_params.multi_items():
        if name in seen:
            raise InvalidRequest(f"{name[:80]} is given twice in the query string.")
        seen.add(name)


async def json_body(request: Request) -> None:
    """Refuse a body whose content type is not that of JSON.

    Raises:
        UnsupportedMediaType: the content type is another one, or missing.
    """
    kind = media_type(request)
    if kind not in JSON_TYPES:
        raise UnsupportedMediaType(f"Send the body as {' or '.join(JSON_TYPES)}{instead_of(kind)}.")


class FrameOptions(Protocol):
    """Parameters beside one frame."""

    @property
    def encoder(self) -> str | None: ...
    def joined(self, fields: Mapping[str, str]) -> Self: ...


Options = TypeVar("Options", bound=FrameOptions)


async def frame_for_map(request: Request, engine: Engine, map_id: str, options: Options) -> tuple[Map, bytes, Options]:
    """The first steps of every route that takes one frame for a map.

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
    """Durations in milliseconds, rounded to the microsecond, as answers show them."""
    return {stage: round(duration, 3) for stage, duration in milliseconds.items()}


EngineDep = Annotated[Engine, Depends(FromState("engine"))]
PrincipalDep = Annotated[Principal, Depends(_principal)]
DeadlineDep = Annotated[RequestDeadline, Depends(_request_deadline)]
MapId = Annotated[str, Path(alias="map", description="Id of the map.", examples=["lab"]), AfterValidator(check_map_id)]
PlaceId = Annotated[
    str, Path(alias="place", description="Id of the place.", examples=["p7"]), AfterValidator(check_place_id)
]
SequenceName = Annotated[
    str,
    Path(alias="sequence", description="Name of the traverse.", examples=["monday"]),
    AfterValidator(check_sequence),
]
IfMatch = Annotated[
    str | None,
    Header(alias="If-Match", description="The ETag of the map as it was read; 412 if the map has changed since."),
]
Page = Annotated[PageParameters, Query()]


class StrictRequest(Request):
    """A request whose JSON body contains only values that can be written as JSON again."""

    async def json(self) -> Any:
        value = parse_json(await self.body(), "The body")
        json_size(value, "The body")
        return value


def _in_turn(endpoint: Callable[..., Any]) -> Callable[..., Coroutine[Any, Any, Any]]:
    """A function that blocks, as one that is run in a thread when it is its caller's turn."""

    @wraps(endpoint)
    async def run(**arguments: Any) -> Any:
        return await in_thread(endpoint, **arguments)

    return run


class StrictRoute(APIRoute):
    """A route that refuses JSON bodies with infinite numbers or lone surrogates.

    A function that blocks is run in a thread when it is its caller's turn; the framework knows no turns.
    """

    def __init__(self, path: str, endpoint: Callable[..., Any], **more: Any) -> None:
        blocks = not inspect.iscoroutinefunction(endpoint)
        super().__init__(path, _in_turn(endpoint) if blocks else endpoint, **more)

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handler = super().get_route_handler()

        async def strict(request: Request) -> Response:
            return await handler(StrictRequest(request.scope, request.receive))

        return strict
