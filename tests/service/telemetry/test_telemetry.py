"""Request ids and the log."""

from __future__ import annotations

import asyncio
import json
import logging
import re

import pytest
from starlette.types import Message, Receive, Scope, Send

from service.telemetry.metrics import Metrics
from service.telemetry.requests import JsonLines, Telemetry
from tests.service.scenes import jpeg
from tests.service.server import Server


def test_a_plain_request_id_is_taken(server: Server) -> None:
    response = server.client.get("/livez", headers={"X-Request-Id": "robot-7:frame.0001"})
    assert response.headers["x-request-id"] == "robot-7:frame.0001"


@pytest.mark.parametrize("given", [None, "", "a b", "x" * 129, "-x", 'quote"', "ä".encode("latin-1"), "<script>"])
def test_any_other_is_replaced(server: Server, given: str | bytes | None) -> None:
    headers = {} if given is None else {"X-Request-Id": given}
    made = server.client.get("/livez", headers=headers).headers["x-request-id"]  # type: ignore[arg-type]
    assert re.fullmatch(r"[0-9a-f]{32}", made)


def test_one_line_for_each_request(server: Server, traverse: str) -> None:
    headers = {"X-Request-Id": "logged-query", "Content-Type": "image/jpeg"}
    frame = jpeg(1)
    response = server.client.post(f"/v1/maps/{traverse}/query?k=1", content=frame, headers=headers)
    line = server.logged_request("logged-query")
    assert line["method"] == "POST" and line["status"] == 200
    assert line["path"] == f"/v1/maps/{traverse}/query" and line["route"] == "/v1/maps/{map}/query"
    assert line["bytes_in"] == len(frame) and line["bytes_out"] == len(response.content)
    assert line["milliseconds"] > 0 and line["map"] == traverse and line["verdict"] == "recognized"
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", line["time"])


def test_failures_are_logged_too(server: Server) -> None:
    server.client.get("/made/up", headers={"X-Request-Id": "logged-404"})
    line = server.logged_request("logged-404")
    assert (line["status"], line["route"], line["problem"]) == (404, "(none)", "unknown-path")


def test_every_line_of_the_server_is_json(server: Server) -> None:
    for line in server.log_file.read_text().splitlines():
        assert {"time", "level", "logger", "message"} <= set(json.loads(line))


def test_a_traceback_stays_on_one_line() -> None:
    try:
        raise ValueError("line one\nline two")
    except ValueError as error:
        record = logging.makeLogRecord({"msg": "broken %s", "args": ("pipe",), "exc_info": (ValueError, error, None)})
    written = JsonLines().format(record)
    assert "\n" not in written
    assert json.loads(written)["message"] == "broken pipe" and "line two" in json.loads(written)["exception"]


@pytest.mark.parametrize("error", [RuntimeError("made\nup"), asyncio.CancelledError()])
def test_a_defect_is_logged_once_with_its_traceback_and_a_request_given_up_as_such(
    error: BaseException, caplog: pytest.LogCaptureFixture
) -> None:
    async def broken(scope: Scope, receive: Receive, send: Send) -> None:
        raise error

    async def nothing() -> Message:
        return {"type": "http.disconnect"}

    async def sent(message: Message) -> None:
        answered.append(message)

    answered: list[Message] = []
    scope: Scope = {"type": "http", "method": "GET", "path": "/livez", "headers": [], "query_string": b"", "app": None}
    asyncio.run(Telemetry(broken, Metrics())(scope, nothing, sent))
    problem = json.loads(answered[1]["body"])
    errors = [record for record in caplog.records if record.levelno >= logging.ERROR]
    if isinstance(error, RuntimeError):
        assert problem["type"].endswith(":internal-error") and "made" not in json.dumps(problem)
        (record,) = errors
        assert record.exc_info is not None and record.request_id == problem["request_id"]  # type: ignore[attr-defined]
        assert json.loads(JsonLines().format(record))["exception"].endswith("RuntimeError: made\nup")
    else:
        assert problem["type"].endswith(":stopping") and problem["status"] == 503 and not errors
        assert b"retry-after" in dict(answered[0]["headers"])


def test_a_line_is_never_of_megabytes() -> None:
    record = logging.makeLogRecord({"msg": "x" * 1_000_000, "path": "y" * 1_000_000, "odd": b"z" * 1_000_000})
    record.exc_info = (ValueError, ValueError("w" * 1_000_000), None)
    assert len(JsonLines().format(record)) < 60_000
