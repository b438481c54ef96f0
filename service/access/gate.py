"""Who is let in: looked at before any byte of a body is read, for every path, and for WebSockets' handshakes.

Whatever ``service.access.roles`` does not say is open needs a key as soon as one was ever created: unknown paths too,
so that a caller without a key learns nothing of what is here.
"""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass

from fastapi.routing import APIRoute, APIWebSocketRoute, iter_route_contexts
from starlette.requests import Request
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from service.access.audit import Refusals, asker_of, note_change
from service.access.keyring import Keyring
from service.access.principals import ANONYMOUS, ASKER, NOBODY, OWNER, Asker, Principal
from service.access.rates import Rates, network_of
from service.access.roles import FORGOTTEN, OPERATIONS, Rule, covers
from service.access.web_origins import check_host, check_page
from service.errors.faults import Fault, KeyRefused, MapForbidden, RoleTooLow
from service.errors.problems import KINDS, problem_response
from service.settings import PREFIX, Settings
from service.telemetry.metrics import Metrics
from service.telemetry.requests import request_id

__all__ = ["ANONYMOUS", "NOBODY", "OWNER", "Access", "Gate", "Principal", "Way", "ways_of"]

WEBSOCKET = "WEBSOCKET"

log = logging.getLogger("placerec.access")


@dataclass(frozen=True)
class Way:
    """One way in: a method on a pattern of paths, and what it needs."""

    method: str
    path: str
    pattern: re.Pattern[str]
    operation: str
    rule: Rule


def ways_of(routes: Iterable[BaseRoute]) -> list[Way]:
    """Every way into an application, in the order in which its routes are tried.

    Raises:
        TypeError: there is a route of a kind that is not known here, and so could not be guarded.
    """
    found = []
    for route in iter_route_contexts(list(routes)):
        if isinstance(route.original_route, APIRoute):
            methods = sorted(route.methods or ())
        elif isinstance(route.original_route, APIWebSocketRoute):
            methods = [WEBSOCKET]
        else:
            raise TypeError(f"access to {route.original_route!r} is not guarded")
        operation = route.name or ""
        rule = OPERATIONS.get(operation, FORGOTTEN)
        found += [Way(method, route.path_format or "", route.path_regex, operation, rule) for method in methods]
    return found


@dataclass(frozen=True)
class Gate:
    """What a service asks of those who come.

    keyring: None: the caller opened the data directory itself, and is its owner.
    loopback: the service listens on this machine only; without keys, requests addressed to other names than its own
        are then refused.
    """

    keyring: Keyring | None
    rates: Rates
    loopback: bool

    def identify(self, scope: Scope) -> Principal:
        """Who sends a request.

        Raises:
            KeyNeeded, KeyRefused, KeysUnreadable, RateExceeded: it is not let in by its key.
            ForeignPage: without keys: a web page of elsewhere sends it.
        """
        if self.keyring is None:
            return OWNER
        headers: list[tuple[bytes, bytes]] = scope["headers"]
        if not self.keyring.demanded:
            check_page(headers)
            if self.loopback:
                check_host(headers)
            return ANONYMOUS
        given = [value for name, value in headers if name == b"authorization"]
        try:
            return self.keyring.principal(given[0] if len(given) == 1 else None)
        except KeyRefused:
            self.rates.admit_failure(address_of(scope))
            raise

    async def turn(self, scope: Scope) -> None:
        """Wait until the next message of a WebSocket may be taken: each counts as a request.

        Raises:
            As for :meth:`identify`: the key was revoked, or has expired, since the handshake.
        """
        self.identify(scope)
        while wait := self.rates.wait(caller_of(scope)):
            await asyncio.sleep(wait)


class Access:
    """ASGI layer that lets requests in or answers them; it comes before the layers that read bodies.

    Sets ``principal`` in the request's state.
    """

    def __init__(self, app: ASGIApp, gate: Gate, ways: list[Way], metrics: Metrics) -> None:
        self.app, self.gate, self.metrics = app, gate, metrics
        self._ways: dict[str, list[Way]] = {}
        for way in ways:
            self._ways.setdefault(way.method, []).append(way)
        self._refusals = Refusals()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        kind = scope["type"]
        if kind not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        state = scope.setdefault("state", {})
        if "request_id" not in state:
            state["request_id"] = request_id(scope["headers"])
        way, path = self._find(scope)
        state["principal"] = NOBODY
        try:
            self._admit(scope, way, path)
        except Fault as error:
            await self._refuse(scope, receive, send, error, way, path)
            return
        asker = asker_of(state["principal"], way.operation if way else "unknown", state, address_of(scope))
        ASKER.set(asker)  # for jobs, too, that change nothing
        if way is not None and way.rule.changes:
            await self._change(scope, receive, send, asker, path)
        else:
            await self.app(scope, receive, send)

    def _find(self, scope: Scope) -> tuple[Way | None, Mapping[str, str]]:
        method = scope["method"] if scope["type"] == "http" else WEBSOCKET
        path: str = scope["path"]
        root: str = scope.get("root_path", "")
        if root and path.startswith(root):
            path = path[len(root) :]
        for way in self._ways.get(method, ()):
            match = way.pattern.match(path)
            if match is not None:
                return way, match.groupdict()
        return None, {}

    def _admit(self, scope: Scope, way: Way | None, path: Mapping[str, str]) -> None:
        state = scope["state"]
        if way is not None and way.rule.role == "open":
            with suppress(Fault):  # then it learns what everybody may
                state["principal"] = self.gate.identify(scope)
            return
        principal = state["principal"] = self.gate.identify(scope)
        if principal is OWNER:
            return
        self.gate.rates.admit(caller_of(scope))
        if way is None:
            return  # to be told that there is no such path, or no such method
        rule = way.rule
        if not covers(principal.role, rule.role):
            raise RoleTooLow(f"The key {principal.name!r} has the role {principal.role}; this needs {rule.role}.")
        if principal.maps is None:
            return
        if rule.maps == "all":
            raise MapForbidden(f"The key {principal.name!r} is limited to some maps, and this tells of all.")
        if "map" in path:
            principal.require(path["map"])

    async def _change(self, scope: Scope, receive: Receive, send: Send, asker: Asker, path: Mapping[str, str]) -> None:
        """Pass on a request that changes a map, and tell of it when it is answered."""
        state = scope["state"]
        status = 0

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                if status == 202:  # a job will do it
                    location = dict(message["headers"]).get(b"location", b"")
                    state.setdefault("noted", {})["job"] = location.rpartition(b"/")[2].decode("latin-1")
            await send(message)

        try:
            await self.app(scope, receive, sending)
        except asyncio.CancelledError:  # the service stops, and says so
            status = status or 503
            raise
        except BaseException:
            status = status or 500
            raise
        finally:
            note_change(asker, path, state.get("noted", {}), status)

    async def _refuse(
        self, scope: Scope, receive: Receive, send: Send, error: Fault, way: Way | None, path: Mapping[str, str]
    ) -> None:
        state = scope["state"]
        kind = KINDS[type(error)]
        scope["route"] = way  # for the log and the counters
        asker = asker_of(state["principal"], way.operation if way else "unknown", state, address_of(scope))
        self._refusals.note(asker, path, kind.status, kind.slug)
        if scope["type"] == "websocket":
            self.metrics.problems.labels(kind.slug).inc()
            answer = problem_response(Request({**scope, "type": "http", "method": "GET"}), error)
            await WebSocket(scope, receive, send).send_denial_response(answer)
            return
        await problem_response(Request(scope), error)(scope, receive, send)


def tell_exposure(gate: Gate, settings: Settings) -> None:
    """Say at the start, where no key is asked for, who may do everything.

    Raises:
        SettingsError: other machines could, and nobody said that they may.
    """
    if gate.keyring is None or gate.keyring.demanded:
        return
    settings.check_exposure()  # again, now that the keys were read
    who = "every process and every user of this machine" if gate.loopback else "EVERY MACHINE that reaches it"
    log.warning(
        "there are no keys: %s may do everything; create one with 'placerec keys create'",
        who,
        extra={"host": settings.host, "port": settings.port, "allow_anonymous": settings.allow_anonymous},
    )
    if settings.allow_anonymous and not gate.loopback:
        log.warning("%sALLOW_ANONYMOUS=true opens the service to the network until the first key", PREFIX)


def address_of(scope: Scope) -> str | None:
    """The address that a request comes from; None where the server does not say."""
    client = scope.get("client")
    return str(client[0]) if client else None


def caller_of(scope: Scope) -> str:
    """Whose requests are counted together: those of one key; without keys, of one address."""
    principal: Principal = scope["state"]["principal"]
    return principal.key_id or network_of(address_of(scope))
