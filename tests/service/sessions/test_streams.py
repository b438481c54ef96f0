"""Sessions over a WebSocket, with another library's client."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import jpeg
from tests.service.server import Server
from tests.service.sessions.test_sessions import again, begin, post, send
from tests.service.wire import ended, get, opened


@contextmanager
def stream(server: Server, map_id: str, session: str) -> Iterator[ClientConnection]:
    address = f"ws://127.0.0.1:{server.port}/v1/maps/{map_id}/sessions/{session}/stream"
    with connect(address, max_size=None, compression=None) as connection:
        yield connection


def ask(connection: ClientConnection, data: bytes, **parameters: object) -> dict[str, Any]:
    if parameters:
        connection.send(json.dumps(parameters))
    connection.send(data)
    answer: dict[str, Any] = json.loads(connection.recv(timeout=60))
    return answer


@pytest.mark.thorough
def test_a_run_over_one_connection(server: Server, traverse: str) -> None:
    session, other = begin(server, traverse), begin(server, traverse)
    with stream(server, traverse, session) as connection:
        for number in range(6):
            answer = ask(connection, again(number), frame=number, k=3)
            expected = send(server, traverse, other, again(number), frame=number, k=3)
            assert answer["candidates"] == expected["candidates"] and len(answer["single"]["matches"]) == 3
        assert answer["verdict"] == "recognized" and answer["frame"] == 5
        assert ask(connection, again(5), frame=5)["repeated"]
        assert ask(connection, again(6))["frames"] == 7, "parameters are not needed"
    assert send(server, traverse, session, again(7))["frames"] == 8, "the session outlives the connection"


@pytest.mark.thorough
def test_odometry_by_pose(server: Server, traverse: str) -> None:
    session, other = begin(server, traverse), begin(server, traverse)
    with stream(server, traverse, session) as connection:
        for number, last in ((0, None), (1, 0), (4, 1), (5, 4)):
            pose = {"odometry_x": 2.0 * number, "odometry_y": 0.0, "odometry_heading": 0.0, "odometry_origin": "a"}
            motion = {} if last is None else {"forward": 2.0 * (number - last)}
            answer = ask(connection, again(number), frame=number, **pose)
            expected = send(server, traverse, other, again(number), frame=number, **motion)
            assert (answer["motion"], answer["candidates"]) == (expected["motion"], expected["candidates"])
            assert ask(connection, again(number), frame=number, **pose)["repeated"]
        assert answer["motion"] == "odometry"
        assert ask(connection, again(6), frame=6, forward=2.0, **pose)["problem"]["status"] == 422


@pytest.mark.thorough
def test_frames_sent_ahead_are_answered_in_their_order(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    with stream(server, traverse, session) as connection:
        for number in range(8):
            connection.send(json.dumps({"frame": number}))
            connection.send(again(number))
        answers = [json.loads(connection.recv(timeout=60)) for _ in range(8)]
    assert [answer["frame"] for answer in answers] == list(range(8))
    assert [answer["frames"] for answer in answers] == list(range(1, 9))


def test_errors_are_reported_and_the_stream_goes_on(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    with stream(server, traverse, session) as connection:
        problems = [
            ask(connection, b"no picture"),
            ask(connection, again(1)[:2000]),
            ask(connection, again(1), frame=-1),
            ask(connection, again(1), speed=3),
        ]
        for message in ("{", "[]"):
            connection.send(message)
            problems.append(json.loads(connection.recv(timeout=60)))
        for _ in range(2):
            connection.send('{"frame": 1}')
        problems.append(json.loads(connection.recv(timeout=60)))
        slugs = [problem["problem"]["type"].rpartition(":")[2] for problem in problems]
        assert slugs == [
            "not-an-image", "truncated-image", "invalid-request", "invalid-request", "malformed-body", "malformed-body",
            "invalid-request",
        ]  # fmt: skip
        assert all(problem["problem"]["request_id"] and problem["problem"]["detail"] for problem in problems)
        good = ask(connection, again(1), frame=9)
        assert good["frames"] == 1
        assert ask(connection, again(1), frame=8)["problem"]["status"] == 409


def test_a_frame_has_one_message_even_if_its_parameters_are_refused(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    with stream(server, traverse, session) as connection:
        for texts in (["{"], ['{"frame": 1}', '{"frame": 2}']):
            for message in texts:
                connection.send(message)
            connection.send(again(1))
        connection.send('{"frame": 3}')
        connection.send(again(3))
        answers = [json.loads(connection.recv(timeout=60)) for _ in range(3)]
        assert ["problem" in answer for answer in answers] == [True, True, False]
        assert (answers[2]["frame"], answers[2]["frames"]) == (3, 1), "the others were not taken in"


def test_a_session_that_is_not_there_is_refused_before_the_handshake(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    for map_id, name, status in ((traverse, "s-0", 404), ("nowhere", session, 404), ("NO", session, 422)):
        with pytest.raises(InvalidStatus) as refused, stream(server, map_id, name):
            pass
        response = refused.value.response
        assert response.status_code == status
        assert response.headers["content-type"] == "application/problem+json"
        assert json.loads(response.body)["status"] == status


def test_a_session_has_at_most_one_stream(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    with stream(server, traverse, session) as connection:
        with pytest.raises(InvalidStatus) as refused, stream(server, traverse, session):
            pass
        assert refused.value.response.status_code == 409
        assert ask(connection, again(0))["frames"] == 1
    with stream(server, traverse, session) as connection:
        assert ask(connection, again(1))["frames"] == 2


def test_a_robot_that_lost_its_connection_silently_takes_its_session_over(server: Server, traverse: str) -> None:
    """The former connection is open, and nobody is there to answer a ping."""
    session = begin(server, traverse)
    lost = opened(server)
    key = base64.b64encode(bytes(16)).decode()
    upgrade = ("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {key}")
    lost.sendall(get(f"/v1/maps/{traverse}/sessions/{session}/stream", *upgrade))
    assert lost.recv(65536).startswith(b"HTTP/1.1 101 ")
    before = ended(server, "lost")
    with stream(server, traverse, session) as connection:
        assert ask(connection, again(0))["frames"] == 1
        assert ended(server, "lost") == before + 1
        with pytest.raises(InvalidStatus) as refused, stream(server, traverse, session):
            pass
        assert refused.value.response.status_code == 409, "this one answers pings"
        assert ask(connection, again(1))["frames"] == 2
    lost.close()


def test_a_session_deleted_during_a_stream(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    with stream(server, traverse, session) as connection:
        ask(connection, again(0))
        server.client.delete(f"/v1/maps/{traverse}/sessions/{session}")
        assert ask(connection, again(1))["problem"]["type"].endswith("unknown-session")
        with pytest.raises(ConnectionClosed):
            connection.recv(timeout=60)


@pytest.mark.thorough
def test_frames_over_the_limit_and_a_service_that_stops(tmp_path: Path) -> None:
    install_coarse_encoder(tmp_path / "models")
    settings = {"encoder": COARSE, "max_image_bytes": 60_000, "root_path": "/placerec"}
    server = Server(tmp_path, settings=settings).wait()
    server.create_map("lab")
    server.enrol("lab", "p", jpeg(1))
    session = server.client.post("/v1/maps/lab/sessions", json={}).json()["id"]
    with stream(server, "lab", session) as connection:
        assert ask(connection, jpeg(1))["frames"] == 1
        connection.send(bytes(200_000))
        with pytest.raises(ConnectionClosed) as closed:
            connection.recv(timeout=60)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009, "message too big"
    with stream(server, "lab", session) as connection:
        assert ask(connection, jpeg(1))["frames"] == 2
        assert server.stop() == 0
        with pytest.raises(ConnectionClosed):
            connection.recv(timeout=60)


def test_a_plain_request_to_a_stream(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    response = server.client.get(f"/v1/maps/{traverse}/sessions/{session}/stream")
    assert response.status_code == 404
    assert post(server, traverse, session, again(1)).status_code == 200
