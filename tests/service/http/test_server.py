"""SIGTERM: readiness goes first, what was begun is answered, what was acknowledged is there afterwards."""

from __future__ import annotations

import signal
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem, typed
from tests.service.wire import eventually, get, opened, post, rest

FRAMES = [jpeg(seed) for seed in range(8)]


@dataclass
class Seen:
    """What one client was answered, by request id, and what it was not answered."""

    statuses: dict[str, int] = field(default_factory=dict)
    stored: list[str] = field(default_factory=list)
    unanswered: dict[str, str] = field(default_factory=dict)


def drive(server: Server, name: str, enrols: bool, seen: Seen, until: threading.Event) -> None:
    """Enrol, or ask, one frame after the other."""
    with httpx.Client(base_url=server.client.base_url, timeout=60) as client:
        number = 0
        while not until.is_set():
            number += 1
            request, data = f"{name}-{number}", FRAMES[number % len(FRAMES)]
            headers = {"X-Request-Id": request, **typed(data)}
            path = f"/v1/maps/storm/places/{request}" if enrols else "/v1/maps/storm/query?k=1"
            try:
                response = client.request("PUT" if enrols else "POST", path, content=data, headers=headers)
            except httpx.TransportError as error:
                seen.unanswered[request] = repr(error)
                if server.process.poll() is not None:
                    return
                time.sleep(0.02)
                continue
            seen.statuses[request] = response.status_code
            if enrols and response.is_success:
                seen.stored.append(request)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Server, list[Seen], int | None]:
    """A server that was stopped in a storm: its folder, itself, what its clients saw, the code that closed a stream."""
    folder = tmp_path_factory.mktemp("storm")
    server = Server(folder, settings={"drain_seconds": 1}).wait()
    server.create_map("storm")
    assert server.enrol("storm", "first", jpeg(1)).status_code == 201
    seen, until = [Seen() for _ in range(7)], threading.Event()
    clients = [
        threading.Thread(target=drive, args=(server, f"c{number}", number < 4, one, until))
        for number, one in enumerate(seen)
    ]
    session = server.client.post("/v1/maps/storm/sessions", json={}).json()["id"]
    address = f"ws://127.0.0.1:{server.port}/v1/maps/storm/sessions/{session}/stream"
    with connect(address, max_size=None, compression=None) as stream:
        stream.send(jpeg(1))
        stream.recv(timeout=60)
        for client in clients:
            client.start()
        assert eventually(lambda: all(len(one.statuses) >= 2 for one in seen))
        server.process.send_signal(signal.SIGTERM)
        with httpx.Client(base_url=server.client.base_url, timeout=60) as probe:
            assert_problem(ready := probe.get("/readyz"), 503, "not-ready")
            assert ready.json()["checks"]["service"] == "it is stopping" and ready.headers["connection"] == "close"
            assert probe.get("/livez").status_code == 200, "it lives on"
            assert probe.post("/v1/maps/storm/query", content=FRAMES[1], headers=typed(FRAMES[1])).status_code == 200
        with pytest.raises(ConnectionClosed) as raised:
            stream.recv(timeout=60)
    assert server.process.wait(60) == 0
    until.set()
    for client in clients:
        client.join(60)
    server.client.close()
    return folder, server, seen, raised.value.rcvd.code if raised.value.rcvd else None


@pytest.mark.thorough
def test_what_was_begun_is_answered(stopped: tuple[Path, Server, list[Seen], int | None]) -> None:
    _, server, seen, code = stopped
    answered = {request: status for one in seen for request, status in one.statuses.items()}
    assert set(answered.values()) <= {200, 201, 503} and list(answered.values()).count(200) > 5
    logged = {line["request_id"]: line["status"] for line in server.lines(message="request")}
    begun = {request for one in seen for request in (*one.statuses, *one.unanswered) if request in logged}
    assert {request: logged[request] for request in begun} == {r: s for r, s in answered.items() if r in begun}
    assert not {request for one in seen for request in one.unanswered} & set(logged), "none was begun and cut off"
    assert code == 1012
    assert not [line for line in server.lines() if line["level"] == "error"]


def test_what_was_acknowledged_is_there_after_a_restart(
    stopped: tuple[Path, Server, list[Seen], int | None],
) -> None:
    folder, _, seen, _ = stopped
    server = Server(folder, settings={"drain_seconds": 60}).wait("/livez")
    stored = {place for one in seen for place in one.stored}
    there, cursor = set[str](), None
    while True:
        page = server.client.get(
            "/v1/maps/storm/places", params={"limit": 1000} | ({"cursor": cursor} if cursor else {})
        )
        there |= {place["id"] for place in page.json()["items"]}
        cursor = page.json()["next_cursor"]
        if cursor is None:
            break
    assert len(stored) > 5 and stored <= there
    # A second signal ends the time in which it would still have been taken out of service, and the waiting.
    with opened(server) as slow:
        slow.sendall(post("/v1/encode", FRAMES[0][:100], length=50_000))
        server.process.send_signal(signal.SIGTERM)
        assert eventually(lambda: server.client.get("/readyz").status_code == 503)
        assert server.client.get("/v1/maps/storm").status_code == 200 and server.process.poll() is None
        assert server.stop() == 0
        assert b"urn:placerec:problem:stopping" in rest(slow)


@pytest.mark.thorough
def test_what_does_not_end_in_time_is_given_up_and_told_so(tmp_path: Path) -> None:
    server = Server(tmp_path, settings={"shutdown_timeout": 0.5, "read_timeout": 300, "request_timeout": 300})
    with opened(server.wait("/livez")) as slow, opened(server) as refused:
        slow.sendall(post("/v1/encode", FRAMES[0][:100], length=50_000))
        # Of a WebSocket that is refused while it opens, the stop must not hear.
        refused.sendall(get("/?" + "x" * 9000, "Connection: Upgrade", "Upgrade: websocket"))
        assert server.client.get("/livez").status_code == 200
        assert server.stop() == 0
        found = rest(slow)
    assert not [line for line in server.lines() if "exception" in line]
    assert b"HTTP/1.1 503" in found and b"urn:placerec:problem:stopping" in found and b"retry-after" in found.lower()
