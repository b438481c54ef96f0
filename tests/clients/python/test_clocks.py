"""A robot's clock or counter that jumps, over HTTP, a WebSocket and the client: no single value locks a session."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from websockets.sync.client import connect

from placerec_client import Client, InvalidParameter, Map, Problem
from tests.service.scenes import jpeg
from tests.service.server import Server, text, typed

FRAMES = [jpeg(number, 64, 48) for number in range(4)]

BEGIN = datetime.now(UTC) - timedelta(minutes=1)
HOUR, YEARS = 3600.0, 20 * 365.25 * 86_400

Sender = Callable[[bytes, dict[str, Any]], dict[str, Any]]


def at(seconds: float, **more: Any) -> dict[str, Any]:
    """The parameters of a frame that was taken so long after the first one."""
    return {"timestamp": (BEGIN + timedelta(seconds=seconds)).isoformat(), **more}


@pytest.fixture(scope="module")
def walk(url: str) -> Iterator[Map]:
    with Client(url) as client:
        made = client.maps.create("clocks")
        for number, frame in enumerate(FRAMES):
            made.places.put(f"p{number}", frame, x=2 * number, y=0, sequence="walk")
        yield made


@contextmanager
def over_http(server: Server, walk: Map, session: str) -> Iterator[Sender]:
    path = f"/v1/maps/{walk.id}/sessions/{session}/frames"
    yield lambda data, given: server.client.post(path, params=text(given), content=data, headers=typed(data)).json()


@contextmanager
def over_a_stream(server: Server, walk: Map, session: str) -> Iterator[Sender]:
    def send(data: bytes, given: dict[str, Any]) -> dict[str, Any]:
        stream.send(json.dumps(given))
        stream.send(data)
        told: dict[str, Any] = json.loads(stream.recv(timeout=60))
        return dict(told.get("problem", told))

    path = f"/v1/maps/{walk.id}/sessions/{session}/stream"
    with connect(f"ws://127.0.0.1:{server.port}{path}", compression=None) as stream:
        yield send


@contextmanager
def by_the_client(server: Server, walk: Map, session: str) -> Iterator[Sender]:
    own = walk.sessions[session]

    def send(data: bytes, given: dict[str, Any]) -> dict[str, Any]:
        try:
            return own.send(data, **given).model_dump()
        except Problem as problem:
            return {"type": problem.slug, "detail": problem.detail}
        except InvalidParameter as error:
            return {"type": "invalid-request", "detail": str(error)}

    yield send


@pytest.fixture(params=[over_http, over_a_stream, by_the_client])
def send(request: pytest.FixtureRequest, server: Server, walk: Map) -> Iterator[Sender]:
    begun = walk.sessions.begin(verify="never", speed_limit=50.0).begin()
    with request.param(server, walk, begun.id) as sender:
        yield sender
    begun.delete()


def kind(told: dict[str, Any]) -> str:
    if "type" in told:
        return str(told["type"]).rpartition(":")[2]
    return "repeated" if told["repeated"] else "goes on" if told.get("note") is None else str(told["note"])


LATE, BAD = "frame-out-of-order", "invalid-request"
BACK, FORWARD, COUNTER, NO_DATE = "clock went back", "clock went ahead", "numbers went from", "ahead of the service's"


@pytest.mark.parametrize(
    "frames",
    [
        pytest.param([(at(0), "goes on"), (at(-HOUR), BACK), (at(1 - HOUR), "goes on")], id="back an hour"),
        pytest.param(
            [(at(0, frame=7), "goes on"), (at(-HOUR, frame=8), BACK), (at(1 - HOUR, frame=9), "goes on")],
            id="back an hour, with numbers",
        ),
        pytest.param(
            [(at(0), "goes on"), (at(YEARS), FORWARD), (at(2), BACK), (at(3), "goes on")], id="20 years ahead once"
        ),
        pytest.param([(at(YEARS), NO_DATE), (at(1), BACK), (at(2), "goes on")], id="20 years ahead in the first frame"),
        pytest.param(
            [(at(0), "goes on"), (at(YEARS), FORWARD), (at(YEARS + 1), NO_DATE), (at(YEARS + 1.5), NO_DATE)],
            id="20 years ahead and staying",
        ),
        pytest.param(
            [(at(-YEARS), "goes on"), (at(1 - YEARS), "goes on"), (at(2 - YEARS), "goes on")], id="a recording of old"
        ),
        pytest.param([(at(0), "goes on"), (at(-0.5), LATE), (at(1), "goes on")], id="back half a second"),
        pytest.param(
            [({"timestamp": "1970-01-01T00:00:05Z"}, "goes on"), (at(0), FORWARD), (at(1), "goes on")],
            id="set by the network after boot",
        ),
        pytest.param(
            [
                (at(0, frame=7), "goes on"),
                (at(1, frame=2**31), COUNTER),
                (at(2, frame=9), COUNTER),
                (at(3, frame=10), "goes on"),
            ],
            id="counter 2147483648",
        ),
        pytest.param(
            [(at(0, frame=7), "goes on"), (at(9, frame=0), COUNTER), (at(10, frame=1), "goes on")],
            id="counter restarts",
        ),
        pytest.param(
            [
                (at(0, frame=7), "goes on"),
                (at(1, frame=8), "goes on"),
                (at(0, frame=7), LATE),
                (at(1, frame=8), "repeated"),
                (at(2, frame=9), "goes on"),
            ],
            id="frames that are sent again",
        ),
        pytest.param(
            [(at(0, frame=2**53), "goes on"), (at(1, frame=2**53 + 1), BAD), (at(2, frame=0), COUNTER)],
            id="the largest number",
        ),
        pytest.param(
            [({"timestamp": "9999-12-31T23:59:59.999999Z"}, NO_DATE), (at(0), BACK), (at(1), "goes on")],
            id="the last moment",
        ),
        pytest.param([({"timestamp": "0001-01-01T00:00:00Z"}, "goes on"), (at(0), FORWARD)], id="the first moment"),
        pytest.param(
            [
                (at(0, frame=1), "goes on"),
                ({"timestamp": float("nan")}, BAD),
                ({"timestamp": float("inf")}, BAD),
                ({"timestamp": -1}, BAD),
                ({"timestamp": 1e300}, BAD),
                ({"timestamp": "1795168800"}, BAD),  # a number is a time to the client
                ({"timestamp": 1795168800_000}, BAD),
                ({"timestamp": "yesterday"}, BAD),
                ({"timestamp": "99999-01-01T00:00:00Z"}, BAD),
                ({"timestamp": "0001-01-01T00:00:00+14:00"}, BAD),
                (at(1, frame=float("nan")), BAD),
                (at(1, frame=-1), BAD),
                (at(1, frame=2**64), BAD),
                (at(1, frame="x"), BAD),
                (at(1, frame=2), "goes on"),
            ],
            id="what is no time and no number",
        ),
    ],
)
def test_no_time_and_no_number_locks_a_session(send: Sender, frames: list[tuple[dict[str, Any], str]]) -> None:
    for number, (given, expected) in enumerate(frames):
        told = send(FRAMES[number % len(FRAMES)], given)
        assert expected in kind(told), told
        if expected in (BACK, FORWARD, COUNTER):
            assert told["motion"] == "sequence"
        if expected == LATE:
            assert "leave it out" in told["detail"]
            assert all(part["timestamp"][:19] in told["detail"] for part in (given, frames[number - 1][0]))


def test_a_client_counts_on_from_the_largest_number(walk: Map) -> None:
    with walk.sessions.begin() as session:
        assert session.send(FRAMES[0], frame=2**53).frame == 2**53
        assert [session.send(frame).frame for frame in FRAMES[1:]] == [0, 1, 2]
        session.send(FRAMES[0], frame=2**53)
        assert walk.sessions[session.id].send(FRAMES[1]).frame == 0, "as one does that takes it up"
