"""Bodies are limited while they arrive, not after."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Iterator
from contextlib import suppress

import httpx
import pytest

from service.errors.faults import InvalidRequest, MalformedBody
from service.http.bodies import json_size, parse_json
from tests.service.scenes import encoded, jpeg, scene
from tests.service.server import Server, assert_problem
from tests.service.wire import eventually

JPEG = {"Content-Type": "image/jpeg"}


def exchange(
    server: Server, sent: bytes, more: Iterator[bytes] | None = None, patience: float = 20
) -> tuple[bytes, int]:
    """What a bare socket is answered, and how many bytes it could send before that."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=patience) as connection:
        connection.sendall(sent)
        count = len(sent)
        connection.setblocking(False)
        answer = b""
        until = time.monotonic() + patience
        while not answer and time.monotonic() < until:
            try:
                answer = connection.recv(65536)
            except BlockingIOError:
                chunk = next(more, b"") if more is not None else b""
                if chunk:
                    with suppress(BlockingIOError):
                        count += connection.send(chunk)
                else:
                    time.sleep(0.01)
        connection.settimeout(max(0.1, until - time.monotonic()))
        with suppress(ConnectionError):  # head and body may come in two pieces
            while not complete(answer) and (piece := connection.recv(65536)):
                answer += piece
        return answer, count


def complete(answer: bytes) -> bool:
    """Whether an answer has come to its end; an interim one (100) has no body."""
    start, end, body = answer.partition(b"\r\n\r\n")
    length = re.search(rb"(?i)\r\ncontent-length: *(\d+)", start)
    return bool(end) and (length is None or len(body) >= int(length[1]))


def head(path: str, *lines: str) -> bytes:
    start = [f"POST {path} HTTP/1.1", "Host: localhost", "Content-Type: image/jpeg"]
    return "\r\n".join([*start, *lines, "", ""]).encode()


def test_a_body_that_announces_too_much_is_refused_unread(tight_server: Server) -> None:
    answer, sent = exchange(tight_server, head("/v1/encode", "Content-Length: 60001"))
    assert answer.startswith(b"HTTP/1.1 413") and b"problem:body-too-large" in answer
    assert sent < 200, "not a byte of the body was asked for"


def test_a_caller_that_asks_first_is_told_before_it_sends(tight_server: Server) -> None:
    answer, _ = exchange(tight_server, head("/v1/encode", "Content-Length: 60001", "Expect: 100-continue"))
    assert answer.startswith(b"HTTP/1.1 413")
    answer, _ = exchange(tight_server, head("/v1/encode", "Content-Length: 500", "Expect: 100-continue"))
    assert answer.startswith(b"HTTP/1.1 100")


def test_a_body_without_a_length_is_cut_at_the_limit(tight_server: Server) -> None:
    def chunks() -> Iterator[bytes]:
        while True:
            yield b"1000\r\n" + b"x" * 4096 + b"\r\n"

    answer, sent = exchange(tight_server, head("/v1/encode", "Transfer-Encoding: chunked"), chunks())
    assert answer.startswith(b"HTTP/1.1 413") and b"problem:body-too-large" in answer
    assert sent < 20_000_000


def test_limits_hold_to_the_byte(tight_server: Server, tight_map: str) -> None:
    picture = encoded(scene(1, 64, 64))
    fitting = picture + b"\0" * (60_000 - len(picture))  # a JPEG ends at its end marker; what follows is not read
    path = f"/v1/maps/{tight_map}/places/p"
    assert tight_server.client.put(path, content=fitting, headers=JPEG).status_code == 201
    assert_problem(tight_server.client.put(path, content=fitting + b"\0", headers=JPEG), 413, "body-too-large")
    part = {"image": ("f.jpg", fitting + b"\0", "image/jpeg")}
    assert_problem(tight_server.client.put(path, files=part), 413, "image-too-large")


def test_json_bodies_have_a_limit_of_their_own(tight_server: Server) -> None:
    response = tight_server.client.post("/v1/maps", json={"id": "x", "description": "d" * 5000})
    assert_problem(response, 413, "body-too-large")


def test_metadata_has_a_limit_of_its_own(tight_server: Server, tight_map: str) -> None:
    picture = encoded(scene(1, 64, 64))
    assert tight_server.enrol(tight_map, "p", picture, metadata={"a": "x" * 192}).status_code == 201
    assert_problem(tight_server.enrol(tight_map, "p", picture, metadata={"a": "x" * 193}), 422, "invalid-request")


def test_a_body_that_trickles_is_not_waited_for(tight_server: Server) -> None:
    start = time.monotonic()
    answer, _ = exchange(tight_server, head("/v1/encode", "Content-Length: 500", "X-Request-Timeout: 0.5"))
    assert answer.startswith(b"HTTP/1.1 503") and b"deadline-exceeded" in answer
    assert 0.4 < time.monotonic() - start < 20, "half a second was asked for; without that it would be thirty"


def test_uploads_share_a_bounded_memory(tight_server: Server, tight_map: str) -> None:
    connections = []
    try:
        for _ in range(9):  # 9 x 55 000 of 500 000 bytes
            connection = socket.create_connection(("127.0.0.1", tight_server.port))
            connection.sendall(head("/v1/encode", "Content-Length: 55001") + b"x" * 55_000)
            connections.append(connection)
        picture = encoded(scene(1), quality=60)
        # Asked about before it is sent, it takes no room from those that are still arriving.
        asked = head("/v1/encode", f"Content-Length: {len(picture)}", "Expect: 100-continue")
        assert eventually(lambda: exchange(tight_server, asked)[0].startswith(b"HTTP/1.1 503")), "all have been read"
        response = tight_server.client.post("/v1/encode", content=picture, headers=JPEG)
        assert_problem(response, 503, "memory-full")
        assert 1 <= int(response.headers["retry-after"]) <= 3
    finally:
        for connection in connections:
            connection.close()

    def is_answered() -> bool:
        return tight_server.client.post("/v1/encode", content=picture, headers=JPEG).status_code == 200

    assert eventually(is_answered), "given back"


def test_a_caller_that_hangs_up_harms_nobody(server: Server) -> None:
    with socket.create_connection(("127.0.0.1", server.port)) as connection:
        connection.sendall(head("/v1/encode", "Content-Length: 5000", "X-Request-Id: hung-up") + b"x" * 100)
    line = server.logged_request("hung-up")
    assert line["status"] == 499 and line["bytes_in"] <= 100
    assert server.client.post("/v1/encode", content=jpeg(1), headers=JPEG).status_code == 200


def test_after_a_refusal_the_connection_still_serves(tight_server: Server) -> None:
    with httpx.Client(base_url=tight_server.client.base_url) as client:
        for _ in range(3):
            assert client.post("/v1/encode", content=b"x" * 200_000, headers=JPEG).status_code == 413
            assert client.get("/livez").status_code == 200


@pytest.mark.parametrize("text", ["{", "", "nul", "'a'", "[" * 100_000, "1" * 5000, b"\xff\xff"])
def test_what_is_not_json(text: str | bytes) -> None:
    with pytest.raises(MalformedBody, match="The body"):
        parse_json(text, "The body")


@pytest.mark.parametrize("value", [float("nan"), {"a": [float("-inf")]}, "\ud800", {"\udfff": 1}])
def test_what_json_cannot_say(value: object) -> None:
    with pytest.raises(InvalidRequest):
        json_size(value, "metadata")


def test_the_size_of_json_is_counted_in_bytes() -> None:
    assert json_size({"ä": [1, 2]}, "metadata") == len('{"ä":[1,2]}'.encode())
