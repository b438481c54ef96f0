"""What a robot may send over a WebSocket before it is told off."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from tests.service.scenes import jpeg
from tests.service.server import Server
from tests.service.wire import ended, eventually, get, open_files, opened, rest

TEXT, CONTINUED, FINAL = 0x01, 0x00, 0x80

KEY = "Sec-WebSocket-Key: YWFhYWFhYWFhYWFhYWFhYQ=="
VERSION = "Sec-WebSocket-Version: 13"
UPGRADE = ("Connection: Upgrade", "Upgrade: websocket")
PATH = "/v1/maps/m/sessions/s/stream"


def frame(first: int, payload: bytes) -> bytes:
    """A frame from a client, with a mask of zeros."""
    assert len(payload) < 126
    return bytes([first, 0x80 | len(payload), 0, 0, 0, 0]) + payload


@pytest.fixture
def stream(strict: Server) -> Iterator[ClientConnection]:
    """A stream into a session of a map of its own."""
    if strict.client.get("/v1/maps/streamed").status_code == 404:
        strict.create_map("streamed")
        assert strict.enrol("streamed", "p", jpeg(1)).status_code == 201
    session = strict.client.post("/v1/maps/streamed/sessions", json={}).json()["id"]
    address = f"ws://127.0.0.1:{strict.port}/v1/maps/streamed/sessions/{session}/stream"
    with connect(address, max_size=None, compression=None) as connection:
        yield connection


def closed_with(connection: ClientConnection) -> int | None:
    """The code with which the service closes."""
    with pytest.raises(ConnectionClosed) as raised:
        while True:
            connection.recv(timeout=60)
    return raised.value.rcvd.code if raised.value.rcvd else None


def test_messages_far_ahead_end_the_stream(strict: Server, stream: ClientConnection) -> None:
    before = ended(strict, "too-many-messages")
    stream.socket.sendall(frame(FINAL | TEXT, b"{}") * 5000)
    assert closed_with(stream) == 1008
    assert ended(strict, "too-many-messages") == before + 1


def test_a_message_of_endless_fragments_ends_it(strict: Server, stream: ClientConnection) -> None:
    stream.socket.sendall(frame(TEXT, b"{") + frame(CONTINUED, b"") * 100)
    assert closed_with(stream) == 1008


def test_a_message_that_is_too_long_ends_it_before_it_came(strict: Server, stream: ClientConnection) -> None:
    size = 1 << 40
    stream.socket.sendall(bytes([FINAL | 0x02, 0x80 | 127]) + size.to_bytes(8, "big") + bytes(4) + b"x" * 1000)
    assert closed_with(stream) == 1009


@pytest.mark.parametrize(
    "sent",
    [frame(FINAL | TEXT, b"\xff"), frame(TEXT, b'"\xc3') + frame(FINAL | CONTINUED, b'("')],
    ids=["whole", "cut"],
)
def test_text_that_is_no_utf_8_ends_it(strict: Server, stream: ClientConnection, sent: bytes) -> None:
    """It is the client's mistake: the log has no error of the service."""
    before, lines = held(strict), strict.lines(level="error")
    stream.socket.sendall(sent)
    assert closed_with(stream) == 1007
    assert eventually(lambda: held(strict) == before)
    assert strict.lines(level="error") == lines, strict.lines(level="error")[-1]["exception"]


def test_a_character_may_be_cut_by_a_fragment(strict: Server, stream: ClientConnection) -> None:
    stream.socket.sendall(frame(TEXT, b'"\xc3') + frame(FINAL | CONTINUED, b'\xa4"'))
    assert json.loads(stream.recv(timeout=60))["problem"]["status"] == 400


def held(server: Server) -> float:
    """Bytes that its uploads take."""
    text = server.client.get("/metrics").text
    return float(text.split("\nplacerec_upload_bytes ")[1].split("\n")[0])


def test_a_message_that_never_ends_is_counted_among_the_uploads(strict: Server, stream: ClientConnection) -> None:
    size = 1_000_000
    stream.socket.sendall(bytes([FINAL | 0x02, 0x80 | 127]) + size.to_bytes(8, "big") + bytes(4) + b"x" * 900_000)
    assert eventually(lambda: held(strict) >= 900_000)
    files = open_files(strict)
    stream.socket.close()
    assert eventually(lambda: held(strict) < 1000), "given back"
    assert eventually(lambda: open_files(strict) < files)


def test_a_frame_is_held_until_it_is_answered_though_the_next_is_always_there(
    strict: Server, stream: ClientConnection
) -> None:
    data, most = jpeg(1), 0.0
    for _ in range(3):
        stream.send(data)
    for number in range(20):
        stream.send(data)
        assert json.loads(stream.recv(timeout=60))["frames"] == number + 1
        most = max(most, held(strict))
    assert 0 < most <= 5 * len(data)
    for _ in range(3):
        stream.recv(timeout=60)
    assert eventually(lambda: held(strict) == 0), "though it goes on"


@pytest.mark.parametrize(
    ("sent", "status", "kind"),
    [
        (get(PATH + "?" + "x" * 9000, *UPGRADE, VERSION, KEY), 431, "head-too-large"),
        (get(PATH, *UPGRADE, VERSION, KEY, "X-Long: " + "x" * 9000), 431, "head-too-large"),
        (get(PATH, *UPGRADE, VERSION, KEY, "Content-Length: 5") + b"12345", 400, "malformed-head"),
        (get(PATH, *UPGRADE, VERSION, KEY, "Content-Length: 50000"), 400, "malformed-head"),
        (get(PATH, *UPGRADE, VERSION, KEY).replace(b"GET", b"POST"), 400, "malformed-head"),
        (get(PATH, *UPGRADE, VERSION), 400, "malformed-head"),
        (get(PATH, *UPGRADE, VERSION, "Sec-WebSocket-Key: short"), 400, "malformed-head"),
        (get(PATH, *UPGRADE, "Sec-WebSocket-Version: 8", KEY), 400, "malformed-head"),
        (get("/v1/nowhere", *UPGRADE, VERSION, KEY), 404, "unknown-path"),
        (get("/v1/maps", *UPGRADE, VERSION, KEY), 404, "unknown-path"),
    ],
)
def test_what_is_no_handshake_is_refused_with_a_problem(server: Server, sent: bytes, status: int, kind: str) -> None:
    connection = opened(server)
    connection.sendall(sent)
    head, _, body = rest(connection).partition(b"\r\n\r\n")
    told, fields = json.loads(body), head.lower().split(b"\r\n")
    assert head.startswith(b"HTTP/1.1 %d " % status) and b"content-type: application/problem+json" in fields
    assert (told["status"], told["type"]) == (status, f"urn:placerec:problem:{kind}") and told["detail"]
    assert b"x-request-id: " + told["request_id"].encode() in fields
    assert (b"sec-websocket-version: 13" in fields) == (status == 400)
    assert eventually(lambda: bool(server.lines(request_id=told["request_id"], problem=kind)))


def test_a_stream_without_frames_ends_with_its_session(strict: Server) -> None:
    session = strict.client.post("/v1/maps/streamed/sessions", json={"expires_after": 1}).json()["id"]
    address = f"ws://127.0.0.1:{strict.port}/v1/maps/streamed/sessions/{session}/stream?token=query-string-secret"
    headers = {"Authorization": "Bearer header-secret", "X-Request-Id": "idle-stream"}
    with connect(address, compression=None, additional_headers=headers) as connection:
        connection.send(json.dumps({"k": 1}))
        assert closed_with(connection) == 1008
    assert eventually(lambda: bool(strict.lines(message="stream", request_id="idle-stream")))
    (line,) = strict.lines(message="stream", request_id="idle-stream")
    assert (line["status"], line["messages_in"], line["messages_out"]) == (101, 1, 0)
