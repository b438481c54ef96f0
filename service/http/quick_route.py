"""Routes that robots ask many times a second: what a plain request says is read straight.

The framework reads each parameter by itself, by way of its documentation, and takes longer for that than all else in
a request takes: with some twenty parameters half a millisecond.  Here the query string is read once, kept, and given
to the parameters' model.  Whatever is not plain (a value that does not fit, a name given twice, a deadline of the
caller's) is left to the framework, which says what is wrong.
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
from service.http.bodies import intake_of
from service.http.dependencies import FromState

READ_HERE = {"map_id", "options", "request", "deadline"}
"""Parameters of a route that are read without the framework; all others must come from the application's state."""

DEADLINE = "x-request-timeout"
KEPT = 512
"""Query strings whose parameters are kept; robots of one fleet ask alike."""

LONGEST_KEPT = 256
"""Bytes of a query string that is kept."""


class QuickRoute(APIRoute):
    """A route of the parameters ``map_id``, ``options`` (a frozen model), ``request``, ``deadline`` and ``FromState``.

    The route's answer is a model.  Other routes of the same router are left as they are.
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
    """Parameters from query strings; those of the latest are kept."""

    def __init__(self, model: type[BaseModel]) -> None:
        self._model = model
        self._kept: dict[bytes, BaseModel] = {}

    def __call__(self, query: bytes) -> BaseModel | None:
        """The parameters; None where they need the framework's care."""
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
