"""Telemetry of every request: its id, its trace, its log line, its metrics; and the answer to unexpected errors."""

from __future__ import annotations

import asyncio
import json
import logging
import logging.config
import random
import re
import time
from collections.abc import Iterable
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from core.errors import PlacerecError
from service.errors.faults import ClientGone, Fault, Stopping
from service.errors.problems import kind_of, problem_response
from service.telemetry.metrics import Metrics

TRACEPARENT = re.compile(rb"([0-9a-f]{2})-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})(-.*)?")
LONGEST = 512
"""Most bytes of a header; later versions of the standard may make it longer than today."""

_ids = random.Random()


@dataclass(frozen=True)
class Trace:
    """The span of one request in a trace.

    Args:
        trace_id: of the trace, 32 hexadecimal digits.
        parent_id: of the caller's span, 16 hexadecimal digits.
        span_id: of this request's span, 16 hexadecimal digits.
        sampled: whether the caller records its span.
    """

    trace_id: str
    parent_id: str
    span_id: str
    sampled: bool

    @property
    def response(self) -> str:
        """The value of the header ``traceresponse``."""
        return f"00-{self.trace_id}-{self.span_id}-{int(self.sampled):02x}"


def read_trace(headers: Iterable[tuple[bytes, bytes]]) -> Trace | None:
    """The trace of a request by its ``traceparent``; None without one, or if it does not conform to the standard.

    Args:
        headers: names in lower case.
    """
    given = [value for name, value in headers if name == b"traceparent"]
    if len(given) != 1 or len(given[0]) > LONGEST:
        return None
    found = TRACEPARENT.fullmatch(given[0].strip(b" \t"))
    if found is None:
        return None
    version, trace_id, parent_id, flags, more = found.groups()
    if version == b"ff" or (version == b"00" and more is not None):
        return None
    if not int(trace_id, 16) or not int(parent_id, 16):
        return None
    span_id = f"{_ids.randrange(1, 1 << 64):016x}"
    return Trace(trace_id.decode(), parent_id.decode(), span_id, bool(int(flags, 16) & 1))


@dataclass(frozen=True)
class Origin:
    """The request for which something is done: its ids, and whether the console has sent it."""

    request_id: str
    trace_id: str | None
    by_console: bool = False


origin: ContextVar[Origin | None] = ContextVar("origin", default=None)
"""The origin of what is being done now; threads that work for a request inherit it."""


_ids = random.Random()
"""Ids have to differ but need not be secret, so they do not cost a system call each."""

REQUEST_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:-]{0,127}")
UNMATCHED = "(none)"
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
FIELDS = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "color_message"}

CONSOLE = b"x-placerec-console"
"""The header by which the console marks its requests, which the latencies that it shows leave out, as do the counts of
answers: a person in front of it is no robot."""


def is_trial() -> bool:
    """Whether a person tries something in the console now."""
    return (request := origin.get()) is not None and request.by_console


LONGEST_PATH = 300
LONGEST_TEXT, LONGEST_TRACEBACK = 4096, 32_768
"""Most characters of one value in a log line, so that no request makes a line of megabytes."""

log = logging.getLogger("placerec.requests")


class JsonLines(logging.Formatter):
    """Formats records as JSON objects of time, level, logger, message, ids of the request, and values of ``extra``."""

    def format(self, record: logging.LogRecord) -> str:
        moment = datetime.fromtimestamp(record.created, UTC)
        line: dict[str, Any] = {
            "time": moment.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": cut(record.getMessage(), LONGEST_TEXT),
        }
        request = origin.get()
        if request is not None:
            line["request_id"] = request.request_id
            if request.trace_id is not None:
                line["trace_id"] = request.trace_id
        for name, value in record.__dict__.items():
            if name not in FIELDS and not name.startswith("_"):  # which libraries add for themselves
                line[name] = cut(value, LONGEST_TEXT) if isinstance(value, str) else value
        if record.exc_info:
            line["exception"] = cut(self.formatException(record.exc_info), LONGEST_TRACEBACK)
        return json.dumps(line, default=lambda value: cut(str(value), LONGEST_TEXT))


def cut(text: str, longest: int) -> str:
    """The text; if it is too long, its first characters and how many more there were."""
    return text if len(text) <= longest else f"{text[:longest]}… ({len(text) - longest} more)"


def configure_logging(level: str) -> None:
    """Send the logs of the service and of the server to standard error as JSON lines."""
    # At level debug uvicorn would log the heads of requests, and with them keys.
    servers = "INFO" if level == "debug" else level.upper()
    logging.config.dictConfig(
        {
            "version": 1,
            "disable_existing_loggers": False,
            "formatters": {"json": {"()": JsonLines}},
            "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "json"}},
            "root": {"handlers": ["stderr"], "level": "WARNING"},
            "loggers": {
                "placerec": {"level": level.upper()},
                # These do not depend on the level: who changed what, and who is let in.
                "placerec.audit": {"level": "INFO"},
                "placerec.access": {"level": "INFO"},
                "core": {"level": level.upper()},
                "uvicorn": {"handlers": [], "level": servers, "propagate": True},
                "uvicorn.error": {"handlers": [], "level": servers, "propagate": True},
                # Requests, WebSockets and refused connections are logged by this service itself.
                "uvicorn.streams": {"handlers": [], "level": "WARNING", "propagate": True},
                "uvicorn.http": {"handlers": [], "level": "ERROR", "propagate": True},
                "uvicorn.access": {"handlers": [], "level": "CRITICAL", "propagate": False},
                # Malformed forms are reported to the caller.
                "python_multipart": {"level": "CRITICAL"},
            },
        }
    )


def request_id(headers: list[tuple[bytes, bytes]]) -> str:
    """The caller's ``X-Request-Id`` if it has a valid form, otherwise a new id."""
    for name, value in headers:
        if name == b"x-request-id":
            given = value.decode("latin-1")
            if REQUEST_ID.fullmatch(given):
                return given
    return f"{_ids.getrandbits(128):032x}"


class Telemetry:
    """The outermost ASGI middleware of the application.

    It sets ``request_id``, ``started`` (``time.monotonic``), ``trace`` and ``trace_id`` (None without a trace) in the
    request's state, returns the ids in ``X-Request-Id`` and ``traceresponse``, and answers HEAD with the route for GET
    (the server drops the body).
    """

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app, self.metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        state = scope.setdefault("state", {})
        state["request_id"], state["started"] = request_id(scope["headers"]), time.monotonic()
        trace = state["trace"] = read_trace(scope["headers"])
        state["trace_id"] = trace.trace_id if trace is not None else None
        by_console = any(name == CONSOLE for name, _ in scope["headers"])
        token = origin.set(Origin(state["request_id"], state["trace_id"], by_console))
        self.metrics.under_way.inc()
        try:
            await (self._stream if scope["type"] == "websocket" else self._answer)(scope, receive, send)
        finally:
            self.metrics.under_way.dec()
            origin.reset(token)

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        method, state = scope["method"], scope["state"]
        inner = {**scope, "method": "GET"} if method == "HEAD" else scope
        state["method"] = method  # for routes whose answer takes long to make
        status, sent = 0, 0

        async def send_marked(message: Message) -> None:
            nonlocal status, sent
            if message["type"] == "http.response.start":
                status = message["status"]
                _mark(message, state["request_id"], state["trace"])
            elif message["type"] == "http.response.body":
                sent += len(message.get("body", b""))
            await send(message)

        try:
            await self.app(inner, receive, send_marked)
        except asyncio.CancelledError:  # the server stops and cannot wait any longer
            if status:
                raise
            stopped = Stopping(
                "The service stopped before the request was answered; it may or may not have been carried out."
            )
            await problem_response(Request(inner), stopped)(inner, receive, send_marked)
        except Exception as error:  # a defect of the service: it is logged, but its text is not sent
            if status:
                _note_broken(error, state)
            else:
                await problem_response(Request(inner), error)(inner, receive, send_marked)
        finally:
            self._record(inner, method, status, sent)

    async def _stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a WebSocket on, and log it when it ends."""
        counts = {"messages_in": 0, "messages_out": 0}
        status = 0

        async def receive_counted() -> Message:
            message = await receive()
            counts["messages_in"] += message["type"] == "websocket.receive"
            return message

        async def send_counted(message: Message) -> None:
            nonlocal status
            counts["messages_out"] += message["type"] == "websocket.send"
            if message["type"] == "websocket.accept":
                status = 101
            elif message["type"] == "websocket.http.response.start":
                status = message["status"]
            if message["type"] in ("websocket.accept", "websocket.http.response.start"):
                _mark(message, scope["state"]["request_id"], scope["state"]["trace"])
            await send(message)

        with suppress(asyncio.CancelledError):
            try:
                await self.app(scope, receive_counted, send_counted)
            finally:
                self._log("stream", scope, "GET", status, counts)

    def _record(self, scope: Scope, method: str, status: int, sent: int) -> None:
        state = scope["state"]
        route = getattr(scope.get("route"), "path", UNMATCHED)
        counted = method if method in METHODS else "OTHER"
        seconds = time.monotonic() - state["started"]
        self.metrics.observe_request(route, counted, status, seconds, by_console=is_trial())
        if "problem" in state:
            self.metrics.problems.labels(state["problem"]).inc()
        self._log("request", scope, method, status, {"bytes_in": state.get("bytes_in", 0), "bytes_out": sent})

    def _log(self, message: str, scope: Scope, method: str, status: int, counts: dict[str, int]) -> None:
        if not log.isEnabledFor(logging.INFO):
            return
        state, client = scope["state"], scope.get("client")
        trace: Trace | None = state["trace"]
        spans = {} if trace is None else {"span_id": trace.span_id, "parent_id": trace.parent_id}
        noted = {"problem": state["problem"]} if "problem" in state else {}
        log.info(
            message,
            extra={
                "request_id": state["request_id"],
                "method": method if method in METHODS else cut(method, 20),
                "path": cut(scope["path"], LONGEST_PATH),
                "route": getattr(scope.get("route"), "path", UNMATCHED),
                "status": status,
                "milliseconds": round((time.monotonic() - state["started"]) * 1e3, 2),
                **counts,
                "client": client[0] if client else None,
                **({"principal": state["principal"].name} if "principal" in state else {}),
                **spans,
                **noted,
                **state.get("noted", {}),
            },
        )


def _note_broken(error: Exception, state: dict[str, Any]) -> None:
    """Log that an answer ended before its end; what is foreseen, as a disk that fails, needs no traceback."""
    cause = error.__cause__  # the framework raises another one from what it cannot answer any more
    if isinstance(cause, ClientGone):
        state["problem"] = kind_of(cause).slug  # for the line of the request
    elif isinstance(cause, Fault | PlacerecError):
        log.error("the answer broke off: %s", cause, extra={"request_id": state["request_id"]})
    else:
        log.error("the answer broke off", exc_info=error, extra={"request_id": state["request_id"]})


def _mark(message: Message, request_id: str, trace: Trace | None) -> None:
    headers = MutableHeaders(scope=message)
    headers["X-Request-Id"] = request_id
    headers["X-Content-Type-Options"] = "nosniff"
    if trace is not None:
        headers["traceresponse"] = trace.response
