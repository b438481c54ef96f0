"""Sessions that services share: a frame may come to any of them, at the same time, and after one was killed."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from service.shared.database import SharedDatabase
from tests.servers.postgres import Postgres
from tests.service.encoders import COARSE
from tests.service.server import Server, assert_problem
from tests.service.sessions.test_sessions import again, begin, post, send
from tests.service.shared.services import MAP, expect_away, fill, two_services
from tests.service.wire import eventually

pytestmark = pytest.mark.postgres

LIMITS = {"max_sessions": 3, "session_expiry": 600}


@pytest.fixture
def services(tmp_path: Path, postgres: Postgres, database: SharedDatabase) -> Iterator[tuple[Server, Server]]:
    with two_services(tmp_path, postgres.address, LIMITS) as both:
        fill(both[0])
        yield both


def beliefs(answer: dict[str, Any]) -> dict[str, float]:
    """The probability of each place."""
    return {one["place"]["id"]: one["probability"] for one in answer["candidates"]}


@pytest.mark.thorough
def test_services_go_on_with_one_session(services: tuple[Server, Server]) -> None:
    one, other = services
    alone, shared = begin(one, MAP), begin(one, MAP)
    for number in range(8):
        motion = {"forward": 2.0} if number else {}
        pose = {"odometry_x": 5.0, "odometry_y": 2.0 * number, "odometry_heading": 90.0, "odometry_origin": "a"}
        expected = send(one, MAP, alone, again(number), frame=number, **motion)
        answer = send(services[number % 2], MAP, shared, again(number), frame=number, **pose)
        assert beliefs(answer) == pytest.approx(beliefs(expected), abs=1e-3)
        assert answer["motion"] == expected["motion"]
        assert (answer["frames"], answer["saved"], answer["frames_lost"]) == (number + 1, True, None)
    # The last frame again, at the service that did not process it.
    repeated = send(one, MAP, shared, again(7), frame=7)
    assert repeated["repeated"] and repeated["candidates"] == answer["candidates"]
    assert_problem(post(other, MAP, alone, again(1), frame=1), 409, "frame-out-of-order")
    listed = [server.client.get(f"/v1/maps/{MAP}/sessions").json()["items"] for server in services]
    assert [(item["id"], item["frames"]) for item in listed[0]] == [(item["id"], 8) for item in listed[1]]

    # Limits hold over both, and a session ends for both.
    begin(other, MAP)
    assert_problem(one.client.post(f"/v1/maps/{MAP}/sessions", json={}), 429, "too-many-sessions")
    assert one.client.delete(f"/v1/maps/{MAP}/sessions/{shared}").status_code == 204
    assert_problem(post(other, MAP, shared, again(1)), 404, "unknown-session")
    # A request that comes again, to the other, begins no second session.
    headers = {"X-Request-Id": "robot-1"}
    twice = [server.client.post(f"/v1/maps/{MAP}/sessions", json={}, headers=headers).json()["id"]
             for server in services]  # fmt: skip
    assert twice[0] == twice[1]
    assert one.client.delete(f"/v1/maps/{MAP}/sessions/{twice[0]}").status_code == 204
    # One that nobody uses expires for both.
    unused = begin(one, MAP, expires_after=1)
    time.sleep(1.1)
    for server in services:
        assert_problem(post(server, MAP, unused, again(1)), 410, "session-expired")


@pytest.mark.thorough
def test_frames_at_the_same_time(services: tuple[Server, Server]) -> None:
    session = begin(services[0], MAP)

    def sent(number: int) -> int:
        response = post(services[number % 2], MAP, session, again(number % 8))
        assert response.status_code == 200, response.text
        frames: int = response.json()["frames"]
        return frames

    with ThreadPoolExecutor(6) as pool:
        frames = list(pool.map(sent, range(24)))
    assert sorted(frames) == list(range(1, 25)), "each frame comes after another one"
    last = [send(server, MAP, session, again(5))["frames"] for server in services]
    assert last == [25, 26]


@pytest.mark.thorough
def test_a_killed_service_and_a_database_that_is_away(
    services: tuple[Server, Server], postgres: Postgres, tmp_path: Path
) -> None:
    one, other = services
    session = begin(one, MAP)
    for number in range(4):
        before = send(one, MAP, session, again(number), frame=number)
    one.kill()
    assert send(other, MAP, session, again(3), frame=3)["candidates"] == before["candidates"]
    assert send(other, MAP, session, again(4), frame=4)["frames"] == 5
    postgres.server.end(signal.SIGINT)
    try:
        content, headers = again(5), {"Content-Type": "image/jpeg"}
        asked = other.client.post(f"/v1/maps/{MAP}/query", content=content, headers=headers)
        for refused in (post(other, MAP, session, content, frame=5), asked):
            expect_away(refused)
        until = time.monotonic() + 60
        while other.client.get("/readyz").status_code == 200:
            assert time.monotonic() < until
            time.sleep(0.2)
        assert "PostgreSQL" in other.client.get("/readyz").json()["checks"]["maps"]
        late = Server(tmp_path / "one", settings={"encoder": COARSE, "database": postgres.address}).wait("/livez")
    finally:
        postgres.server.start()
    other.wait()  # it is ready again by itself, and so is one that was started in the meantime
    # A connection of before may be noticed to be broken by the request that uses it.
    assert eventually(lambda: post(other, MAP, session, again(5), frame=5).status_code == 200)
    assert send(late.wait(), MAP, session, again(6), frame=6)["frames"] == 7
    late.stop()
