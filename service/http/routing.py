"""What routes are made of: their dependencies, what a route that takes a frame begins with, and two kinds of routes.

:class:`StrictRoute` reads JSON bodies strictly.  :class:`QuickRoute` serves queries, which robots send all the time.
The framework validates each parameter by itself, which takes half a millisecond for some twenty parameters: longer
than everything else around the work itself.  The quick route parses the query string once, validates it with the model
of the parameters, and remembers the result.  A request that is out of the ordinary (an invalid value, a name given
twice, an X-Request-Timeout) goes the framework's way, which also says what is wrong with it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Coroutine, Mapping
from typing import Annotated, Any, Protocol, Self, TypeVar, get_args, get_origin, get_type_hints
from urllib.parse import parse_qsl

from fastapi import Depends, Header, Path, Query, Request, params
from fastapi.routing import APIRoute
from pydantic import AfterValidator, BaseModel, ValidationError
from starlette.responses import Response

from core.errors import InvalidIdentifier
from core.maps import Map
from core.places import check_map_id, check_place_id, check_sequence
from service.access.roles import Principal
from service.engine.engine import Engine
from service.engine.queue import RequestDeadline
from service.errors.faults import InvalidRequest, UnsupportedMediaType
from service.http.bodies import intake_of, json_size, parse_json
from service.http.schemas import PageParameters
from service.http.uploads import instead_of, media_type, read_frame

JSON_TYPES = ("application/json", "application/merge-patch+json")


class FromState:
    """A dependency that gives what the application keeps under a name (see :mod:`service.app.runtime`)."""

    def __init__(self, name: str) -> None:
        self.name = name

    async def __call__(self, request: Request) -> Any:
        return getattr(request.app.state, self.name)


async def _whole_deletion(request: Request) -> None:
    """Refuse a deletion that says more than its path: whoever says more means to delete less.

    Raises:
        InvalidRequest: the query string has a parameter that the operation does not know, or there is a body.
    """
    known = {one.alias for one in request.scope["route"].dependant.query_params}
    if unknown := [name for name in request.query_params if name not in known]:
        raise InvalidRequest(f"query.{unknown[0][:80]}: A deletion takes no such parameter; nothing was deleted.")
    if await request.body():
        raise InvalidRequest("A deletion takes no body; nothing was deleted.")


WHOLE_DELETION = Depends(_whole_deletion)
"""What every DELETE depends on."""


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


READ_HERE = {"map_id", "options", "request", "deadline"}
"""Parameters of a route that are read without the framework; all others must come from the application's state."""

DEADLINE = "x-request-timeout"
KEPT = 512
"""Query strings whose parameters are remembered; the robots of one fleet send the same ones."""

LONGEST_KEPT = 256
"""Bytes of the longest query string that is remembered."""


class QuickRoute(APIRoute):
    """A route of the parameters ``map_id``, ``options`` (a frozen model), ``request``, ``deadline`` and ``FromState``.

    The function returns a model.  Functions with other parameters get the framework's own route.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        careful = super().get_route_handler()
        hints = get_type_hints(self.endpoint, include_extras=True)
        kept = {name: state for name, hint in hints.items() if (state := _state_name(hint)) is not None}
        if hints.keys() - {"return"} - kept.keys() != READ_HERE:
            return careful
        endpoint: Callable[..., Coroutine[Any, Any, BaseModel]] = self.endpoint
        read = _Reader(get_type_hints(self.endpoint)["options"])
        exclude_unset = self.response_model_exclude_unset

        async def quick(request: Request) -> Response:
            options = read(request.scope["query_string"])
            name = request.path_params["map"]
            if options is None or DEADLINE in request.headers or not _is_map_id(name):
                return await careful(request)
            intake = intake_of(request)
            deadline = RequestDeadline(intake.deadline, intake.hung_up)
            given = {parameter: getattr(request.app.state, state) for parameter, state in kept.items()}
            answer = await endpoint(map_id=name, options=options, request=request, deadline=deadline, **given)
            return Response(answer.model_dump_json(exclude_unset=exclude_unset), media_type="application/json")

        return quick


def _state_name(hint: Any) -> str | None:
    """Under which name the application keeps the value of a parameter; None for other parameters."""
    marks = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
    sources = (mark.dependency for mark in marks if isinstance(mark, params.Depends))
    return next((source.name for source in sources if isinstance(source, FromState)), None)


def _is_map_id(name: str) -> bool:
    try:
        check_map_id(name)
    except InvalidIdentifier:
        return False
    return True


class _Reader:
    """Parses query strings into parameters and remembers the latest ones."""

    def __init__(self, model: type[BaseModel]) -> None:
        self._model = model
        self._kept: dict[bytes, BaseModel] = {}

    def __call__(self, query: bytes) -> BaseModel | None:
        """The parameters; None if the framework has to handle the query string."""
        found = self._kept.get(query)
        if found is not None:
            return found
        pairs = parse_qsl(query.decode("latin-1"), keep_blank_values=True)
        if len(dict(pairs)) < len(pairs):
            return None
        try:
            made = self._model.model_validate(dict(pairs))
        except ValidationError:
            return None
        if len(query) <= LONGEST_KEPT:
            if len(self._kept) >= KEPT:
                self._kept.clear()
            self._kept[query] = made
        return made


class StrictRequest(Request):
    """A request whose JSON body contains only what can be written as JSON again."""

    async def json(self) -> Any:
        value = parse_json(await self.body(), "The body")
        json_size(value, "The body")
        return value


class StrictRoute(APIRoute):
    """A route that refuses JSON bodies with infinite numbers or lone surrogates."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handler = super().get_route_handler()

        async def strict(request: Request) -> Response:
            return await handler(StrictRequest(request.scope, request.receive))

        return strict
