"""The header ``traceparent``, to the letter of the W3C's recommendation."""

from __future__ import annotations

import re

import pytest

from service.telemetry.requests import read_trace
from tests.service.server import Server

TRACE, SPAN = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"


@pytest.mark.parametrize(
    ("given", "sampled"),
    [
        (f"00-{TRACE}-{SPAN}-01", True),
        (f"00-{TRACE}-{SPAN}-00", False),
        (f"00-{TRACE}-{SPAN}-fe", False),
        (f"  00-{TRACE}-{SPAN}-03\t", True),
        (f"cc-{TRACE}-{SPAN}-01", True),
        (f"cc-{TRACE}-{SPAN}-01-what-the-future-brings", True),
    ],
)
def test_a_trace_is_taken(given: str, sampled: bool) -> None:
    trace = read_trace([(b"host", b"x"), (b"traceparent", given.encode())])
    assert trace is not None and (trace.trace_id, trace.parent_id, trace.sampled) == (TRACE, SPAN, sampled)
    assert re.fullmatch(rf"00-{TRACE}-[0-9a-f]{{16}}-0{int(sampled)}", trace.response)
    assert trace.span_id not in (SPAN, "0" * 16)


@pytest.mark.parametrize(
    "given",
    [
        "",
        "00",
        f"00-{TRACE}-{SPAN}",
        f"00-{TRACE}-{SPAN}-1",
        f"00-{TRACE}-{SPAN}-01-more",
        f"00-{TRACE}-{SPAN}-01-",
        f"ff-{TRACE}-{SPAN}-01",
        f"00-{'0' * 32}-{SPAN}-01",
        f"00-{TRACE}-{'0' * 16}-01",
        f"00-{TRACE.upper()}-{SPAN}-01",
        f"00-{TRACE}-{SPAN}-0x",
        f"cc-{TRACE}-{SPAN}-01.",
        f"cc-{TRACE}-{SPAN}-01-" + "x" * 600,
        f"00-{TRACE}-{SPAN}-01\n",
    ],
)
def test_anything_else_is_no_trace(given: str) -> None:
    assert read_trace([(b"traceparent", given.encode())]) is None


def test_two_of_them_are_none() -> None:
    header = (b"traceparent", f"00-{TRACE}-{SPAN}-01".encode())
    assert read_trace([header, header]) is None and read_trace([]) is None


def test_it_is_answered_and_logged(server: Server) -> None:
    headers = {"traceparent": f"00-{TRACE}-{SPAN}-01", "X-Request-Id": "traced"}
    response = server.client.get("/v1/maps/absent", headers=headers)
    line = server.logged_request("traced")
    assert (line["trace_id"], line["parent_id"]) == (TRACE, SPAN)
    assert response.headers["traceresponse"] == f"00-{TRACE}-{line['span_id']}-01"
    other = server.client.get("/livez", headers={"traceparent": "00-1-2-3", "X-Request-Id": "untraced"})
    assert "traceresponse" not in other.headers and "trace_id" not in server.logged_request("untraced")


def test_a_job_is_logged_with_the_trace_of_its_caller(server: Server) -> None:
    server.create_map("traced")
    headers = {"traceparent": f"00-{TRACE}-{SPAN}-01", "X-Request-Id": "asks-for-a-job"}
    asked = server.client.post("/v1/maps/traced/prune", json={}, headers=headers)
    assert asked.status_code == 202, asked.text
    (line,) = server.lines(message="job queued", job=asked.json()["id"])
    assert (line["trace_id"], line["request_id"]) == (TRACE, "asks-for-a-job")
