"""How much time the check of keys adds to each request.

    python -m benchmarks.access

The layer of ``service.access.gate`` alone, around an application that does nothing: the time of a request through it
less that of one without it, with the headers that a robot sends.  The key, the rate, the role and the map are
all checked.
"""

from __future__ import annotations

import asyncio
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import typer
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from benchmarks.report import report
from service.access.gate import Access, endpoints_of
from service.access.keys import Keys
from service.app.application import create_app
from service.fairness import RefusalPace
from service.settings import Settings

REQUESTS = 5000
ROUNDS = 9
HEADERS = (
    (b"host", b"127.0.0.1:8000"),
    (b"accept", b"*/*"),
    (b"accept-encoding", b"gzip, deflate"),
    (b"connection", b"keep-alive"),
    (b"user-agent", b"robot/1.0"),
    (b"content-type", b"image/jpeg"),
    (b"content-length", b"48213"),
    (b"x-request-id", b"0f5b3c2d1e4a49f78a6b5c4d3e2f1a0b"),
)


async def _nothing(_scope: Scope, _receive: Receive, _send: Send) -> None:
    """The application behind the layer."""


async def _receive() -> Message:
    raise AssertionError("nothing reads")


async def _send(_message: Message) -> None:
    raise AssertionError("nothing is answered")


async def _time(app: ASGIApp, method: str, path: str, headers: list[tuple[bytes, bytes]]) -> float:
    """Microseconds of one request; the median of some rounds."""
    rounds = []
    for _ in range(ROUNDS):
        scopes: list[dict[str, Any]] = [
            {
                "type": "http",
                "method": method,
                "path": path,
                "root_path": "",
                "headers": headers,
                "client": ("10.0.0.7", 40_000),
                "state": {"request_id": "0f5b3c2d1e4a49f78a6b5c4d3e2f1a0b", "trace_id": None},
            }
            for _ in range(REQUESTS)
        ]
        began = time.perf_counter()
        for scope in scopes:
            await app(scope, _receive, _send)
        rounds.append(1e6 * (time.perf_counter() - began) / REQUESTS)
    return statistics.median(rounds)


async def measure(folder: Path) -> dict[str, float]:
    """Microseconds that the layer adds to a request of each kind."""
    found: dict[str, float] = {}
    query, last = ("POST", "/v1/maps/lab/query"), ("GET", "/v1/encoders")
    for name, (method, path), with_key in (
        ("query, with a key", query, True),
        ("listing of encoders, with a key", last, True),
        ("query, without keys", query, False),
    ):
        data_dir = folder / name
        headers = list(HEADERS)
        if with_key:
            _, token = Keys.of(data_dir).create("robot", "query", None if path == last[1] else ["lab", "yard"])
            headers.append((b"authorization", f"Bearer {token}".encode()))
        app = create_app(Settings(host="127.0.0.1", data_dir=data_dir, rate_per_key=1e6, rate_burst=1_000_000))
        layer = Access(_nothing, app.state.gate, endpoints_of(app.routes), app.state.metrics, RefusalPace())
        with app.state.gate.keyring:
            found[name] = await _time(layer, method, path, headers) - await _time(_nothing, method, path, headers)
    return found


def main() -> None:
    """Measure, print a table and write JSON."""
    with tempfile.TemporaryDirectory() as folder:
        found = asyncio.run(measure(Path(folder)))
    report(
        "access",
        "Time that the access layer adds to a request",
        ["request", "µs"],
        list(found.items()),
        {"microseconds": found},
    )


if __name__ == "__main__":
    typer.run(main)
