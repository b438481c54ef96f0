"""Around every request: its id, its log line, its place in the histogram, and the answer when all else fails."""

from __future__ import annotations

import json
import logging
import logging.config
import random
import re
import time
from datetime import UTC, datetime
from typing import Any

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.metrics import Metrics
from service.problems import problem_response

_ids = random.Random()
"""Ids need to differ, not to be secret: asking the system for each one's bytes would cost more than all of its use."""

REQUEST_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:-]{0,127}")
UNMATCHED = "(none)"
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
FIELDS = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "color_message"}

log = logging.getLogger("placerec.requests")


class JsonLines(logging.Formatter):
    """One JSON object a line: time, level, logger, message, and what the caller put in ``extra``."""

    def format(self, record: logging.LogRecord) -> str:
        moment = datetime.fromtimestamp(record.created, UTC)
        line: dict[str, Any] = {
            "time": moment.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line.update({name: value for name, value in record.__dict__.items() if name not in FIELDS})
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def configure_logging(level: str) -> None:
    """Send the service's and the server's logs to standard error as JSON lines."""
    logging.config.dictConfig(
        {
            "version": 1,
            "disable_existing_loggers": False,
            "formatters": {"json": {"()": JsonLines}},
            "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "json"}},
            "root": {"handlers": ["stderr"], "level": "WARNING"},
            "loggers": {
                "placerec": {"level": level.upper()},
                "core": {"level": level.upper()},
                "uvicorn": {"handlers": [], "level": level.upper(), "propagate": True},
                "uvicorn.error": {"handlers": [], "level": level.upper(), "propagate": True},
                # Each request has a line of our own.
                "uvicorn.access": {"handlers": [], "level": "CRITICAL", "propagate": False},
                # Broken forms are the caller's affair.
                "python_multipart": {"level": "CRITICAL"},
            },
        }
    )


def request_id(headers: list[tuple[bytes, bytes]]) -> str:
    """The caller's ``X-Request-Id`` if it is a plain one, else a new id."""
    for name, value in headers:
        if name == b"x-request-id":
            given = value.decode("latin-1")
            if REQUEST_ID.fullmatch(given):
                return given
    return f"{_ids.getrandbits(128):032x}"


class Telemetry:
    """Outermost ASGI layer of the application.

    Sets ``request_id`` and ``started`` (``time.monotonic``) in the request's state, returns the
    id in ``X-Request-Id``, and answers GET's route for HEAD (the server drops the body).
    """

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app, self.metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        method = scope["method"]
        state = scope.setdefault("state", {})
        state["request_id"], state["started"] = request_id(scope["headers"]), time.monotonic()
        inner = {**scope, "method": "GET"} if method == "HEAD" else scope
        status, sent = 0, 0

        async def send_marked(message: Message) -> None:
            nonlocal status, sent
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-Id"] = state["request_id"]
                headers["X-Content-Type-Options"] = "nosniff"
            elif message["type"] == "http.response.body":
                sent += len(message.get("body", b""))
            await send(message)

        try:
            await self.app(inner, receive, send_marked)
        except Exception as error:  # a defect of ours: logged there, and told to nobody else
            if status:
                log.exception("the answer broke off", extra={"request_id": state["request_id"]})
            else:
                await problem_response(Request(inner), error)(inner, receive, send_marked)
        finally:
            self._record(inner, method, status, sent)

    def _record(self, scope: Scope, method: str, status: int, sent: int) -> None:
        state = scope["state"]
        seconds = time.monotonic() - state["started"]
        route = getattr(scope.get("route"), "path", UNMATCHED)
        counted = method if method in METHODS else "OTHER"
        self.metrics.observe_request(route, counted, status, seconds)
        noted = {"problem": state["problem"]} if "problem" in state else {}
        for problem in noted.values():
            self.metrics.problems.labels(problem).inc()
        if not log.isEnabledFor(logging.INFO):
            return
        client = scope.get("client")
        log.info(
            "request",
            extra={
                "request_id": state["request_id"],
                "method": method,
                "path": scope["path"],
                "route": route,
                "status": status,
                "milliseconds": round(seconds * 1e3, 2),
                "bytes_in": state.get("bytes_in", 0),
                "bytes_out": sent,
                "client": client[0] if client else None,
                **noted,
                **state.get("noted", {}),
            },
        )
