"""Kinds of routes: one that reads JSON bodies strictly, and a fast one for queries that robots send all the time.

The framework validates each parameter by itself, which takes half a millisecond for some twenty parameters: longer than
everything else around the work itself.  The fast route parses the query string once, validates it with the model of the
parameters, and remembers the result.  A request that is out of the ordinary (an invalid value, a name given twice, an
X-Request-Timeout) goes the framework's way, which also says what is wrong with it.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Annotated, Any, get_args, get_origin, get_type_hints
from urllib.parse import parse_qsl

from fastapi import params
from fastapi.routing import APIRoute
from pydantic import BaseModel, ValidationError
from starlette.requests import Request
from starlette.responses import Response

from core.errors import InvalidIdentifier
from core.places import check_map_id
from service.engine.queue import RequestDeadline
from service.http.bodies import intake_of, json_size, parse_json
from service.http.dependencies import FromState

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
