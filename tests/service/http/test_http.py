"""Callers who are slow, long-winded or many do not keep the others from their answers."""

from __future__ import annotations

import json
import socket
from contextlib import suppress

import pytest

from tests.service.scenes import jpeg
from tests.service.server import Server
from tests.service.wire import answer, ended, eventually, get, open_files, opened, post, rest


def problem(data: bytes) -> tuple[int, str]:
    """Status and kind of an answer that is a problem."""
    start, _, body = data.partition(b"\r\n\r\n")
    assert b"application/problem+json" in start and b"Connection: close" in start, data
    told = json.loads(body)
    assert told["status"] == int(start.split(b" ", 2)[1]) and told["detail"] and told["request_id"]
    return told["status"], told["type"].removeprefix("urn:placerec:problem:")


@pytest.mark.thorough
def test_the_loris_and_the_half_sent_are_gone_and_a_robot_is_answered_meanwhile(strict: Server) -> None:
    strict.create_map("busy")
    assert strict.enrol("busy", "p1", jpeg(1)).status_code == 201
    before = open_files(strict)
    slow: list[socket.socket] = []
    for number in range(300):  # each has the half of a head, and some send a little more of it
        connection = opened(strict, f"127.0.0.{2 + number % 3}")
        connection.sendall(b"POST /v1/encode HTTP/1.1\r\nHost: localhost\r\nX-Slow: ")
        slow.append(connection)
    half: list[socket.socket] = []
    for _ in range(40):
        connection = opened(strict, "127.0.0.5")
        connection.sendall(post("/v1/encode", b"\xff\xd8" * 500, length=50_000))
        half.append(connection)
    assert eventually(lambda: open_files(strict) >= before + 300, 5)
    for seed in range(10):
        assert strict.query("busy", jpeg(1), k=1)["matches"][0]["place"]["id"] == "p1"
        for connection in slow[seed::10]:
            try:
                connection.sendall(b"x")
            except ConnectionError:  # its time is up
                break
    assert {problem(rest(connection)) for connection in slow if connection.fileno() >= 0} == {(408, "head-too-slow")}
    assert {answer(connection)[0] for connection in half} == {503}
    for connection in half:
        connection.close()
    assert eventually(lambda: open_files(strict) <= before + 3)


@pytest.mark.thorough
def test_a_connection_that_says_nothing_is_closed(strict: Server) -> None:
    silent, blank, kept = opened(strict), opened(strict), opened(strict)
    blank.sendall(b"\r\n")
    kept.sendall(get("/livez"))
    assert answer(kept)[0] == 200
    assert rest(silent) == b""
    assert rest(blank) == b"", "empty lines are no request, and buy no time"
    assert rest(kept) == b""
    assert ended(strict, "silent") >= 2 and ended(strict, "idle") >= 1


@pytest.mark.parametrize(
    ("sent", "told"),
    [
        (get("/" + "x" * 2000), (414, "url-too-long")),
        (get("/livez?" + "x" * 2000), (414, "url-too-long")),
        (get("/livez", *[f"X-{n}: 1" for n in range(20)]), (431, "head-too-large")),
        (get("/livez", "X-Long: " + "x" * 4000), (431, "head-too-large")),
        (b"GET /livez HTTP/1.1\r\nX-Endless: " + b"x" * 2_000_000, (431, "head-too-large")),
        (b"\x16\x03\x01\x02\x00\x01\x00", (400, "malformed-head")),
        (b"GET /livez HTTP/1.1\r\nHost: a\r\nContent-Length: 1\r\nTransfer-Encoding: chunked\r\n\r\n", (400, None)),
        (b"GET /livez HTTP/9.9\r\n\r\n", (400, "malformed-head")),
        (b"GET /livez HTTP/1.1\r\n\r\n", (400, "malformed-head")),  # no Host
        (get("/livez", "Host: localhost"), (400, "malformed-head")),  # a second one
        (b"GET /livez HTTP/1.0\r\nHost: a\r\nhost: b\r\n\r\n", (400, "malformed-head")),
        (b"GET /livez HTTP/1.1\r\nHost: a/b\r\n\r\n", (400, "malformed-head")),
        (b"GET /livez HTTP/1.1\r\nHost: user@a\r\n\r\n", (400, "malformed-head")),
        (get("/livez", "Transfer-Encoding: gzip, chunked"), (501, "unknown-transfer-coding")),
        (get("/livez", "Transfer-Encoding: identity"), (501, "unknown-transfer-coding")),
        (get("/livez", "Transfer-Encoding: chunked, chunked"), (400, "malformed-head")),
    ],
)
def test_a_head_beyond_the_limits_is_refused(strict: Server, sent: bytes, told: tuple[int, str | None]) -> None:
    connection = opened(strict)
    with suppress(ConnectionError):  # it may be refused while it is sent
        connection.sendall(sent)
    status, slug = problem(rest(connection))
    assert (status, slug) == (told[0], told[1] or slug)


def test_a_head_just_within_the_limits_is_taken(strict: Server) -> None:
    with opened(strict) as connection:
        connection.sendall(get("/livez?" + "x" * 1980, *[f"X-{n}: {'y' * 100}" for n in range(18)]))
        assert answer(connection)[0] == 200


@pytest.mark.parametrize("host", ["localhost", "a_b.example:8000", "[::1]:8000", "127.0.0.1", "localhost:"])
def test_every_host_is_taken(server: Server, host: str) -> None:
    with opened(server) as connection:
        connection.sendall(f"GET /livez HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        assert answer(connection)[0] == 200


def test_a_client_of_http_1_0_need_not_name_the_host(server: Server) -> None:
    with opened(server) as connection:
        connection.sendall(b"GET /livez HTTP/1.0\r\n\r\n")
        assert answer(connection)[0] == 200


def test_what_follows_a_chunked_body_is_neither_kept_nor_endless(strict: Server) -> None:
    start = (
        b"POST /v1/encode HTTP/1.1\r\nHost: localhost\r\nContent-Type: image/jpeg\r\nTransfer-Encoding: chunked\r\n\r\n"
    )
    with opened(strict) as connection:
        connection.sendall(start + b"3\r\nabc\r\n0\r\nX-Trailer: 1\r\n\r\n")
        assert answer(connection)[0] in (415, 422)
    connection = opened(strict)
    connection.sendall(start + b"3\r\nabc\r\n0\r\n" + b"X-Trailer: 1\r\n" * 1000)
    assert problem(rest(connection)) == (431, "head-too-large")
    connection = opened(strict)
    connection.sendall(start + b"no number\r\n")
    assert problem(rest(connection)) == (400, "malformed-head")


def test_requests_sent_ahead_are_bounded_and_those_taken_are_answered(strict: Server) -> None:
    connection = opened(strict)
    connection.sendall(get("/version") * 500)
    found = rest(connection)
    answered = found.count(b"HTTP/1.1 200 OK")
    assert 1 <= answered <= 9 and found.count(b"connection: close") == 1
    assert ended(strict, "pipelining") >= 1
    upgrade = opened(strict)
    keys = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
    keys.append("Sec-WebSocket-Key: YWFhYWFhYWFhYWFhYWFhYQ==")
    upgrade.sendall(post("/v1/encode", jpeg(3)) + get("/v1/maps/m/sessions/s/stream", *keys))
    found = rest(upgrade)
    assert found.startswith(b"HTTP/1.1 200 OK") and found.count(b"HTTP/1.1") == 1, "none in the midst of an answer"


def test_what_is_broken_behind_a_request_does_not_cut_its_answer_off(strict: Server) -> None:
    connection = opened(strict)
    connection.sendall(post("/v1/encode", jpeg(3)) + b"\x00\x01 garbage\r\n\r\n")
    found = rest(connection)
    assert found.startswith(b"HTTP/1.1 200 OK") and b"connection: close" in found.lower()


@pytest.mark.thorough
def test_a_caller_that_does_not_read_is_cut_off(strict: Server) -> None:
    before = ended(strict, "write-timeout")
    with opened(strict, receive_buffer=4096) as connection:
        connection.sendall(get("/openapi.json") * 8)
        assert eventually(lambda: ended(strict, "write-timeout") > before)


def test_one_address_has_its_share_of_the_connections(strict: Server) -> None:
    working = []
    for _ in range(150):
        connection = opened(strict, "127.0.0.9")
        connection.sendall(post("/v1/encode", b"\xff\xd8", length=5000))
        working.append(connection)
    assert strict.client.get("/livez").status_code == 200, "others are served"
    one_more = opened(strict, "127.0.0.9")
    one_more.sendall(get("/livez"))
    found = rest(one_more)
    if b"200 OK" not in found:  # unless the first of them were given up by now
        assert problem(found) == (503, "too-many-connections") and b"Retry-After: " in found
    for connection in working:
        connection.close()
    assert b"HTTP/1.1 200" in found or ended(strict, "too-many-connections") >= 1
