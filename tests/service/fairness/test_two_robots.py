"""Two keys at one service: whatever one of them takes, the other is served and never refused.

Nothing here is timed: the greedy one holds what it holds until the test has seen the other one served.
"""

from __future__ import annotations

import re
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass

import httpx
import pytest

from service.access.keys import Keys
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem
from tests.service.wire import answer, eventually, opened

MAP = "lab"
SETTINGS = {
    "queue_length": 4,
    "max_sessions": 4,
    "event_listeners": 4,
    "job_watchers": 4,
    "max_image_bytes": 100_000,
    "max_batch_bytes": 400_000,
    "max_upload_memory": 1_000_000,
}
JPEG = {"Content-Type": "image/jpeg"}


@dataclass(frozen=True)
class Pair:
    """A service and its two keys."""

    server: Server
    robot: httpx.Client
    greedy: httpx.Client


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    folder = tmp_path_factory.mktemp("pair")
    keys = Keys.of(folder / "data")
    _, admin = keys.create("admin", "admin")
    tokens = [keys.create(name, "query")[1] for name in ("robot", "greedy")]
    server = Server(folder, SETTINGS, key=admin).wait()
    server.create_map(MAP)
    for number in range(4):
        assert server.enrol(MAP, f"p{number}", jpeg(number)).status_code == 201
    with ExitStack() as clients:
        robot, greedy = (
            clients.enter_context(
                httpx.Client(
                    base_url=server.client.base_url,
                    timeout=20,
                    headers={"Authorization": f"Bearer {token}"},
                    limits=httpx.Limits(max_connections=100),
                )
            )
            for token in tokens
        )
        yield Pair(server, robot, greedy)
    assert server.stop() == 0


def ask(client: httpx.Client, seed: int) -> httpx.Response:
    return client.post(f"/v1/maps/{MAP}/query", content=jpeg(seed), headers=JPEG)


def test_queries_of_one_key_leave_another_its_turns(pair: Pair) -> None:
    over, statuses = threading.Event(), Counter[int]()

    def flood(number: int) -> None:
        while not over.is_set():
            statuses[ask(pair.greedy, number).status_code] += 1

    with ThreadPoolExecutor(16) as threads:
        floods = [threads.submit(flood, number) for number in range(16)]
        try:
            assert eventually(lambda: statuses[503] >= 16), "the greedy one has more than it may have"
            assert [ask(pair.robot, number).status_code for number in range(20)] == [200] * 20
            batch = {f"f{number}": (f"{number}.jpg", jpeg(number), "image/jpeg") for number in range(3)}
            for _ in range(3):
                assert pair.robot.post(f"/v1/maps/{MAP}/query:batch", files=batch).status_code == 200
        finally:
            over.set()
        for one in floods:
            one.result()
    assert set(statuses) == {200, 503} and statuses[200] > 0, "the other one is served, too"


def test_sessions_of_one_key_leave_another_its_share(pair: Pair) -> None:
    def create(client: httpx.Client) -> httpx.Response:
        return client.post(f"/v1/maps/{MAP}/sessions", json={})

    taken = [create(pair.greedy).json()["id"] for _ in range(4)]
    assert_problem(create(pair.greedy), 429, "too-many-sessions")
    own = [create(pair.robot) for _ in range(2)]
    assert [one.status_code for one in own] == [201, 201]
    assert_problem(create(pair.greedy), 429, "too-many-sessions")
    assert_problem(create(pair.robot), 429, "too-many-sessions")
    for session in taken[:2]:
        gone = pair.greedy.get(f"/v1/maps/{MAP}/sessions/{session}")
        assert "room" in assert_problem(gone, 410, "session-expired")["detail"]
    for session in [*taken[2:], *(one.json()["id"] for one in own)]:
        assert pair.server.client.delete(f"/v1/maps/{MAP}/sessions/{session}").status_code == 204


def test_streams_of_one_key_leave_another_its_share(pair: Pair) -> None:
    events = f"/v1/maps/{MAP}/events"
    with ExitStack() as streams:
        taken = [streams.enter_context(pair.greedy.stream("GET", events)) for _ in range(4)]
        assert [one.status_code for one in taken] == [200] * 4
        assert_problem(pair.greedy.get(events), 503, "too-many-listeners")
        own = streams.enter_context(pair.robot.stream("GET", events))
        assert own.status_code == 200
        told = own.iter_text()
        assert "listening" in next(told)
        assert "listening" in taken[3].read().decode(), "it has ended"
        assert_problem(pair.greedy.get(events), 503, "too-many-listeners")


def test_uploads_of_one_key_leave_another_its_share(pair: Pair) -> None:
    part = b'--x\r\nContent-Disposition: form-data; name="f"; filename="f"\r\nContent-Type: image/jpeg\r\n\r\n'
    head = (
        f"POST /v1/maps/{MAP}/query:batch HTTP/1.1\r\nHost: localhost\r\nContent-Length: 390000\r\n"
        f"Authorization: {pair.greedy.headers['Authorization']}\r\n"
        "Content-Type: multipart/form-data; boundary=x\r\n\r\n"
    )

    def held() -> float:
        found = re.search(r"(?m)^placerec_upload_bytes (\S+)$", pair.server.client.get("/metrics").text)
        return float(found[1]) if found else 0.0

    uploads: list[socket.socket] = []
    try:
        for number in range(3):
            uploads.append(opened(pair.server))
            uploads[-1].sendall(head.encode() + part + b"x" * 300_000)
            arrived = 300_000 * (number + 1)
            assert eventually(lambda arrived=arrived: held() > arrived), "its bytes are held"  # type: ignore[misc]
        padded = jpeg(1)[:2] + (b"\xff\xfe\xff\xff" + b"x" * 0xFFFD) + jpeg(1)[2:]
        batch = {f"f{number}": (f"{number}.jpg", padded, "image/jpeg") for number in range(4)}
        assert pair.robot.post(f"/v1/maps/{MAP}/query:batch", files=batch).status_code == 200
        status, found = answer(uploads[-1])
        assert status == 503 and b"retry-after" in found.lower()
    finally:
        for one in uploads:
            one.close()
    assert eventually(lambda: held() == 0)
