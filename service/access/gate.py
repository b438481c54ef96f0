"""Access control: requests and WebSocket handshakes are let in or refused before any byte of a body is read.

The gate asks for a key, its role and its maps, and bounds the rate of each caller.  Where there are no keys yet, it
refuses what a web page makes a browser send, since a browser on this machine sends whatever any page asks it to.

As soon as a key was ever created, everything needs a key that ``service.access.roles`` does not declare open.  That
includes unknown paths, so that a caller without a key learns nothing about what exists.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from urllib.parse import urlsplit

from fastapi.routing import APIRoute, APIWebSocketRoute, iter_route_contexts
from starlette.requests import Request
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from service.access.audit import ASKER, Asker, Disclosures, Refusals, asker_of, note_change
from service.access.keyring import Keyring
from service.access.rates import Rates, network_of
from service.access.roles import ANONYMOUS, NOBODY, OPERATIONS, OWNER, UNLISTED, Principal, Rule, covers
from service.errors.faults import Fault, ForeignPage, KeyNeeded, KeyRefused, MapForbidden, RateExceeded, RoleTooLow
from service.errors.problems import KINDS, problem_response
from service.fairness import CALLER, RefusalPace
from service.settings import PREFIX, Settings
from service.telemetry.metrics import Metrics
from service.telemetry.requests import request_id

Headers = list[tuple[bytes, bytes]]

WHO_AM_I = "read_own_key"
"""The operation by which a caller without a key learns that it needs one, as the console does when it is opened."""

OWN_SITES = frozenset({b"same-origin", b"none"})
"""Values of ``Sec-Fetch-Site``: a page of this service, and an address that a person typed."""


def check_page(headers: Headers) -> None:
    """Refuse requests from pages of other origins.

    Raises:
        ForeignPage: the headers say that the request comes from such a page.
    """
    host = origin = site = None
    for name, value in headers:
        if name == b"origin":
            origin = value
        elif name == b"sec-fetch-site":
            site = value
        elif name == b"host":
            host = value
    if site is not None and site not in OWN_SITES:
        raise ForeignPage(
            "The request comes from a web page of another site, which is refused while the service has no keys."
        )
    if origin is not None and _host_of(origin) != (host or b"").lower():
        raise ForeignPage(
            "The request comes from a web page of another origin, which is refused while the service has no keys."
        )


def _host_of(origin: bytes) -> bytes | None:
    """The host and port of an Origin header; None if it is not an origin."""
    try:
        return urlsplit(origin.decode("latin-1")).netloc.lower().encode("latin-1")
    except ValueError:
        return None


def check_host(headers: Headers, loopback: bool, names: frozenset[str]) -> None:
    """Refuse requests that a page of another site may have sent under a name that it has had lead here.

    Such a page needs a name of its own in the DNS.  An address is none, and neither is a name without a dot.

    Args:
        loopback: whether the service listens on loopback alone; then it has no other names than this machine's.
        names: further names, in lower case, under which the service is reached.

    Raises:
        ForeignPage: the Host header names another host, or there are two.
    """
    named = [value for name, value in headers if name == b"host"]
    if len(named) > 1 or (named and not _is_own(named[0], loopback, names)):
        raise ForeignPage(
            "While the service has no keys, it answers only requests to "
            + ("localhost or 127.0.0.1" if loopback else "addresses, or names without a dot")
            + ", and to the names in PLACEREC_ALLOWED_HOSTS. Create a key to use it under any name."
        )


@lru_cache(64)
def _is_own(host: bytes, loopback: bool, names: frozenset[str]) -> bool:
    name = _name_of(host)
    if name in names or is_loopback_host(host):
        return True
    return not loopback and name != "" and ("." not in name or is_address(name))


def _name_of(host: bytes) -> str:
    """The name or address in a Host header, in lower case; empty if it has none."""
    try:
        return urlsplit(f"//{host.decode('ascii')}").hostname or ""
    except ValueError:
        return ""


def is_address(name: str) -> bool:
    """Whether a name is an address of IPv4 or IPv6."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@lru_cache(64)
def is_loopback_host(host: bytes) -> bool:
    """Whether a Host header is a loopback name or address."""
    name = _name_of(host)
    if name == "localhost" or name.endswith(".localhost"):
        return True
    return is_address(name) and ipaddress.ip_address(name).is_loopback


WEBSOCKET = "WEBSOCKET"

log = logging.getLogger("placerec.access")


@dataclass(frozen=True)
class Endpoint:
    """One method of one route, and the rule that applies to it."""

    method: str
    path: str
    pattern: re.Pattern[str]
    operation: str
    rule: Rule


def endpoints_of(routes: Iterable[BaseRoute]) -> list[Endpoint]:
    """Every method of every route of an application, in the order in which the routes are tried.

    Raises:
        TypeError: a route is of a kind that is not known here, so it could not be guarded.
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
        rule = OPERATIONS.get(operation, UNLISTED)
        found += [Endpoint(method, route.path_format or "", route.path_regex, operation, rule) for method in methods]
    return found


@dataclass(frozen=True)
class Gate:
    """Decides who a caller is, and how many requests it may send.

    Args:
        keyring: the keys; None if the caller opened the data directory itself, and so is its owner.
        rates: the limits on requests a second.
        loopback: whether the service listens only on this machine; while there are no keys, requests to other host
            names are then refused.
        hosts: further names, in lower case, under which a service without keys is reached.
    """

    keyring: Keyring | None
    rates: Rates
    loopback: bool
    hosts: frozenset[str] = frozenset()

    def identify(self, scope: Scope) -> Principal:
        """Who sends a request.

        Raises:
            KeyNeeded, KeyRefused, KeysUnreadable: the request has no valid key.
            RateExceeded: too many wrong keys came from its address.
            ForeignPage: there are no keys, and the request comes from a web page of another site.
        """
        if self.keyring is None:
            return OWNER
        headers: list[tuple[bytes, bytes]] = scope["headers"]
        if not self.keyring.demanded:
            check_page(headers)
            check_host(headers, self.loopback, self.hosts)
            return ANONYMOUS
        given = [value for name, value in headers if name == b"authorization"]
        try:
            return self.keyring.principal(given[0] if len(given) == 1 else None)
        except KeyRefused:
            self.rates.admit_failure(address_of(scope))
            raise

    async def turn(self, scope: Scope) -> None:
        """Wait until the rate allows the next message of a WebSocket; each message counts as a request.

        Raises:
            Fault: as for :meth:`identify`, if the key was revoked or has expired since the handshake.
        """
        self.identify(scope)
        while wait := self.rates.wait(caller_of(scope)):
            await asyncio.sleep(wait)


class Access:
    """ASGI middleware that lets requests in or refuses them; it comes before the layers that read bodies.

    It sets ``principal`` and, once they are let in, ``caller`` in the request's state.

    Args:
        pace: at which callers are told to come again.
    """

    def __init__(
        self, app: ASGIApp, gate: Gate, endpoints: list[Endpoint], metrics: Metrics, pace: RefusalPace
    ) -> None:
        self.app, self.gate, self.metrics, self._pace = app, gate, metrics, pace
        self._endpoints: dict[str, list[Endpoint]] = {}
        for endpoint in endpoints:
            self._endpoints.setdefault(endpoint.method, []).append(endpoint)
        self._refusals, self._disclosures = Refusals(), Disclosures()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        kind = scope["type"]
        if kind not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        state = scope.setdefault("state", {})
        if "request_id" not in state:
            state["request_id"] = request_id(scope["headers"])
        endpoint, path = self._find(scope)
        state["principal"] = NOBODY
        try:
            self._admit(scope, endpoint, path)
        except Fault as error:
            await self._refuse(scope, receive, send, error, endpoint, path)
            return
        asker = asker_of(state["principal"], endpoint.operation if endpoint else "unknown", state, address_of(scope))
        ASKER.set(asker)  # also for requests that change nothing: they may start jobs
        CALLER.set(asker.caller)
        state["caller"] = asker.caller
        if endpoint is not None and endpoint.rule.changes:
            await self._change(scope, receive, send, asker, path)
        elif endpoint is not None and endpoint.rule.shows:
            await self._show(scope, receive, send, asker, path)
        else:
            await self.app(scope, receive, send)

    def _find(self, scope: Scope) -> tuple[Endpoint | None, Mapping[str, str]]:
        method = scope["method"] if scope["type"] == "http" else WEBSOCKET
        path: str = scope["path"]
        root: str = scope.get("root_path", "")
        if root and path.startswith(root):
            path = path[len(root) :]
        for endpoint in self._endpoints.get(method, ()):
            match = endpoint.pattern.match(path)
            if match is not None:
                return endpoint, match.groupdict()
        return None, {}

    def _admit(self, scope: Scope, endpoint: Endpoint | None, path: Mapping[str, str]) -> None:
        state = scope["state"]
        if endpoint is not None and endpoint.rule.role == "open":
            with suppress(Fault):  # without a valid key it sees what everybody may see
                state["principal"] = self.gate.identify(scope)
            return
        principal = state["principal"] = self.gate.identify(scope)
        if principal is OWNER:
            return
        self.gate.rates.admit(caller_of(scope))
        if endpoint is None:
            return  # the router answers that there is no such path or method
        rule = endpoint.rule
        if not covers(principal.role, rule.role):
            raise RoleTooLow(
                f"The key {principal.name!r} has the role {principal.role}; this operation needs {rule.role}."
            )
        if principal.maps is None:
            return
        if rule.maps == "all":
            raise MapForbidden(f"The key {principal.name!r} is limited to certain maps, but this shows all maps.")
        if "map" in path:
            principal.require(path["map"])

    async def _change(self, scope: Scope, receive: Receive, send: Send, asker: Asker, path: Mapping[str, str]) -> None:
        """Pass on a request that changes a map, and write it to the audit trail once it is answered."""
        state = scope["state"]
        status = 0

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                if status == 202:  # a job will make the change
                    location = dict(message["headers"]).get(b"location", b"")
                    state.setdefault("noted", {})["job"] = location.rpartition(b"/")[2].decode("latin-1")
            await send(message)

        try:
            await self.app(scope, receive, sending)
        except asyncio.CancelledError:  # the service is stopping
            status = status or 503
            raise
        except BaseException:
            status = status or 500
            raise
        finally:
            note_change(asker, path, state.get("noted", {}), status)

    async def _show(self, scope: Scope, receive: Receive, send: Send, asker: Asker, path: Mapping[str, str]) -> None:
        """Pass on a request for pictures, and write it to the audit trail when it is answered with some."""
        state = scope["state"]

        async def sending(message: Message) -> None:
            begins = message["type"] == "http.response.start" and message["status"] < 300
            if begins and state.get("noted", {}).get("pictures", True):
                self._disclosures.note(asker, path, message["status"])
            await send(message)

        await self.app(scope, receive, sending)

    async def _refuse(
        self,
        scope: Scope,
        receive: Receive,
        send: Send,
        error: Fault,
        endpoint: Endpoint | None,
        path: Mapping[str, str],
    ) -> None:
        state = scope["state"]
        kind = KINDS[type(error)]
        scope["route"] = endpoint  # for the log and the metrics
        asker = asker_of(state["principal"], endpoint.operation if endpoint else "unknown", state, address_of(scope))
        if not (isinstance(error, KeyNeeded) and asker.operation == WHO_AM_I):
            self._refusals.note(asker, path, kind.status, kind.slug)
        if isinstance(error, RateExceeded) and (pause := self._pace.pause(asker.caller)):
            await asyncio.sleep(pause)
        if scope["type"] == "websocket":
            self.metrics.problems.labels(kind.slug).inc()
            answer = problem_response(Request({**scope, "type": "http", "method": "GET"}), error)
            await WebSocket(scope, receive, send).send_denial_response(answer)
            return
        await problem_response(Request(scope), error)(scope, receive, send)


def warn_if_exposed(gate: Gate, settings: Settings) -> None:
    """Warn at the start if there are no keys, so that everybody who reaches the service may do everything.

    Raises:
        SettingsError: other machines can reach the service, and the settings do not allow anonymous use.
    """
    if gate.keyring is None or gate.keyring.demanded:
        return
    settings.check_exposure()  # again, because the keys have been read since
    who = "every process and every user of this machine" if gate.loopback else "EVERY MACHINE that reaches it"
    log.warning(
        "there are no keys: %s may do everything; create one with 'placerec keys create'",
        who,
        extra={"host": settings.host, "port": settings.port, "allow_anonymous": settings.allow_anonymous},
    )
    if settings.allow_anonymous and not gate.loopback:
        log.warning("%sALLOW_ANONYMOUS=true opens the service to the network until the first key", PREFIX)


def address_of(scope: Scope) -> str | None:
    """The address that a request comes from; None if the server does not know it."""
    client = scope.get("client")
    return str(client[0]) if client else None


def caller_of(scope: Scope) -> str:
    """The name under which requests are counted: the key's id or, without a key, the address."""
    principal: Principal = scope["state"]["principal"]
    return principal.key_id or network_of(address_of(scope))
