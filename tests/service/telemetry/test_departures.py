"""Clients that go away at any moment leave one line in the log, and no traceback."""

from __future__ import annotations

import asyncio
import base64
import json
import logging
import socket
import struct
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
from starlette.middleware.exceptions import ExceptionMiddleware
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from core.errors import PlacerecError, StorageFailure
from service.errors.faults import Fault
from service.http.bodies import BodyLimit, UploadMemory
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.telemetry.requests import Telemetry
from tests.service.scenes import jpeg
from tests.service.server import Server
from tests.service.wire import opened


def stack(answer: Response) -> ASGIApp:
    """The layers of the application around one answer, with what the framework does about errors."""

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        await answer(scope, receive, send)

    async def refused(_request: Request, error: Exception) -> Response:
        return Response(str(error), 500)

    handlers: dict[Any, Any] = {Fault: refused, PlacerecError: refused}
    inner = BodyLimit(ExceptionMiddleware(app, handlers), Settings(), UploadMemory(1 << 20))
    return Telemetry(inner, Metrics())


def answered(app: ASGIApp, gone: asyncio.Event | None = None) -> list[Message]:
    """What is sent in answer to a GET, whose client goes away as soon as the answer has begun."""
    sent: list[Message] = []

    async def work() -> None:
        begun = asyncio.Event()

        async def receive() -> Message:
            await begun.wait()
            return {"type": "http.disconnect"}

        async def send(message: Message) -> None:
            sent.append(message)
            begun.set()

        scope: Scope = {"type": "http", "method": "GET", "path": "/x", "headers": [], "query_string": b"", "app": None}
        await app(scope, receive, send)

    asyncio.run(asyncio.wait_for(work(), 30))
    return sent


async def endless() -> AsyncIterator[bytes]:
    yield b"first"
    await asyncio.Event().wait()


def test_an_answer_that_is_being_sent_ends_without_an_error_when_nobody_reads_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.INFO, "placerec"):
        sent = answered(stack(StreamingResponse(endless())))
    assert sent[0]["status"] == 200
    (line,) = caplog.records
    assert line.getMessage() == "request" and line.exc_info is None


@pytest.mark.parametrize("error", [StorageFailure("The disk refused to read."), RuntimeError("a defect")])
def test_an_answer_that_breaks_off_has_a_traceback_only_if_that_was_not_foreseen(
    error: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    async def broken() -> AsyncIterator[bytes]:
        yield b"first"
        raise error

    answered(stack(StreamingResponse(broken())))
    (record,) = (one for one in caplog.records if one.levelno >= logging.WARNING)
    assert record.getMessage().startswith("the answer broke off")
    if isinstance(error, StorageFailure):
        assert "The disk refused to read." in record.getMessage() and record.exc_info is None
    else:
        assert record.exc_info is not None


FORM = b'--b\r\nContent-Disposition: form-data; name="places"\r\n\r\n[]\r\n--b\r\n'
KEY = base64.b64encode(bytes(16)).decode()
UPGRADE = ("Upgrade: websocket", "Connection: Upgrade", f"Sec-WebSocket-Key: {KEY}", "Sec-WebSocket-Version: 13")

DEPARTURES: dict[str, tuple[str, str, tuple[str, ...], bytes]] = {
    "in a frame": ("PUT", "/v1/maps/{map}/places/x", ("Content-Type: image/jpeg", "Content-Length: 5000"), b"x" * 9),
    "in a form": (
        "POST",
        "/v1/maps/{map}/places",
        ("Content-Type: multipart/form-data; boundary=b", "Content-Length: 5000"),
        FORM,
    ),
    "in a form of a job": (
        "POST",
        "/v1/maps/{map}/places?background=true",
        ("Content-Type: multipart/form-data; boundary=b", "Content-Length: 5000"),
        FORM,
    ),
    "in a map": ("POST", "/v1/maps/import?id=new", ("Content-Type: application/x-tar", "Content-Length: 5000"), b"x"),
    "in chunks": (
        "POST",
        "/v1/maps/{map}/query",
        ("Content-Type: image/jpeg", "Transfer-Encoding: chunked"),
        b"5\r\nab",
    ),
    "before the answer": ("POST", "/v1/maps/{map}/query", ("Content-Type: image/jpeg",), jpeg(1)),
    "in an export": ("GET", "/v1/maps/{map}/export", (), b""),
    "in events": ("GET", "/v1/maps/{map}/events", (), b""),
    "in the events of a job": ("GET", "/v1/jobs/{job}/events", (), b""),
    "in a long poll": ("GET", "/v1/jobs/{job}?wait=20", (), b""),
    "in a stream": ("GET", "/v1/maps/{map}/sessions/{session}/stream", UPGRADE, b""),
    "in a message": ("GET", "/v1/maps/{map}/sessions/{session}/stream", UPGRADE, b"\x82\xfe\x10\x00abcdxyz"),
}


def reset(connection: socket.socket) -> None:
    """Close a connection as one does that is torn down."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()


@pytest.mark.thorough
@pytest.mark.parametrize("leave", [socket.socket.close, reset], ids=["closes", "resets"])
@pytest.mark.parametrize("name", DEPARTURES)
def test_a_client_that_goes_away_leaves_one_line(
    server: Server, map_id: str, name: str, leave: Callable[[socket.socket], None]
) -> None:
    server.enrol(map_id, "p1", jpeg(1))
    session = server.client.post(f"/v1/maps/{map_id}/sessions", json={}).json()["id"]
    job = server.client.post(f"/v1/maps/{map_id}/verify", params={"background": "true"}).json().get("id")
    method, path, lines, body = DEPARTURES[name]
    request = f"gone-{map_id}"
    if method != "GET" and not any("Length" in one or "Encoding" in one for one in lines):
        lines = (*lines, f"Content-Length: {len(body)}")
    target = path.format(map=map_id, session=session, job=job)
    head = "\r\n".join([f"{method} {target} HTTP/1.1", "Host: localhost", f"X-Request-Id: {request}", *lines, "", ""])
    connection = opened(server)
    connection.sendall(head.encode() + (b"" if lines == UPGRADE else body))
    if lines == UPGRADE:
        assert connection.recv(1000).startswith(b"HTTP/1.1 101")
        connection.sendall(body)
    leave(connection)
    message = "stream" if lines == UPGRADE else "request"
    server.lines_soon(message=message, request_id=request)
    mine = [one for one in server.lines(request_id=request) if one["logger"] == "placerec.requests"]
    assert len(mine) == 1, mine
    assert not [one for one in server.lines() if "exception" in one], json.dumps(mine)
