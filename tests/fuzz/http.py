"""Sends bytes that are no proper HTTP: they must be refused or the connection closed, and other clients unharmed."""

from __future__ import annotations

import random
import re
import socket
import time
from collections.abc import Iterator

HOST = b"Host: localhost\r\n"
JSON = b"Content-Type: application/json\r\n"
BODY = b'{"id": "smuggled"}'
SECOND = b"0\r\n\r\nGET /livez HTTP/1.1\r\n\r\n"
PATIENCE = 10.0
"""Seconds in which an answer, or the end of the connection, has to come; for what is whole but wrong."""

NOT_IMPLEMENTED = 501
"""The answer to a transfer coding that is not known, which is the client's mistake all the same."""

STATUS = re.compile(rb"HTTP/1\.1 (\d{3}) ")


def _post(headers: bytes, body: bytes = BODY) -> bytes:
    return b"POST /v1/maps HTTP/1.1\r\n" + HOST + JSON + headers + b"\r\n" + body


MALFORMED: dict[str, bytes] = {
    "no request line": b"\r\n\r\n\r\n\0\0\r\n\r\n",
    "another version": b"GET /livez HTTP/9.9\r\n" + HOST + b"\r\n",
    "the next version": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    "another protocol": b"\x16\x03\x01\x02\0\x01\0\x01\xfc\x03\x03" + bytes(200) + b"\r\n\r\n",
    "an unknown method": b"B\xc3\xa4H /livez HTTP/1.1\r\n" + HOST + b"\r\n",
    "a control byte in the path": b"GET /liv\0ez HTTP/1.1\r\n" + HOST + b"\r\n",
    "a header without a colon": b"GET /livez HTTP/1.1\r\n" + HOST + b"nonsense\r\n\r\n",
    "a header with a blank in its name": b"GET /livez HTTP/1.1\r\n" + HOST + b"a b: c\r\n\r\n",
    "a control byte in a header": b"GET /livez HTTP/1.1\r\n" + HOST + b"a: \0\r\n\r\n",
    "a huge header": b"GET /livez HTTP/1.1\r\n" + HOST + b"a: " + b"x" * 1_000_000 + b"\r\n\r\n",
    "a huge path": b"GET /" + b"x" * 1_000_000 + b" HTTP/1.1\r\n" + HOST + b"\r\n",
    "fifty thousand headers": b"GET /livez HTTP/1.1\r\n" + HOST + b"a: b\r\n" * 50_000 + b"\r\n",
    "two lengths": _post(b"Content-Length: 18\r\nContent-Length: 3\r\n"),
    "lengths in a list": _post(b"Content-Length: 18, 3\r\n"),
    "length and chunks": _post(b"Content-Length: 18\r\nTransfer-Encoding: chunked\r\n", SECOND),
    "chunks and length": _post(b"Transfer-Encoding: chunked\r\nContent-Length: 4\r\n", b"5\r\n{}   \r\n0\r\n\r\n"),
    "a negative length": _post(b"Content-Length: -1\r\n"),
    "a length with a sign": _post(b"Content-Length: +18\r\n"),
    "a length in hexadecimal": _post(b"Content-Length: 0x12\r\n"),
    "a length beyond numbers": _post(b"Content-Length: 99999999999999999999999999\r\n"),
    "an unknown coding": _post(b"Transfer-Encoding: gzip\r\n"),
    "a coding before chunks": _post(b"Transfer-Encoding: gzip, chunked\r\n", b"0\r\n\r\n"),
    "chunks twice": _post(b"Transfer-Encoding: chunked\r\nTransfer-Encoding: chunked\r\n", b"0\r\n\r\n"),
    "a chunk of no number": _post(b"Transfer-Encoding: chunked\r\n", b"zz\r\n{}\r\n0\r\n\r\n"),
    "a chunk beyond numbers": _post(b"Transfer-Encoding: chunked\r\n", b"ffffffffffffffffffff\r\n{}\r\n0\r\n\r\n"),
    "a chunk with a sign": _post(b"Transfer-Encoding: chunked\r\n", b"-2\r\n{}\r\n0\r\n\r\n"),
    "a longer chunk than it says": _post(b"Transfer-Encoding: chunked\r\n", b"2\r\n{}{}\r\n0\r\n\r\n"),
    "a folded header": b"GET /livez HTTP/1.1\r\n" + HOST + b"a: b\r\n  c\r\nb\r\n\r\n",
    "a bare CR": b"GET /livez HTTP/1.1\rHost: localhost\r\r",
}  # fmt: skip
"""Name -> bytes that no proper client sends."""


def spoken(port: int, sent: bytes, half_close: bool = True) -> tuple[list[int], bool]:
    """Send bytes on a new connection; the statuses that come back, and whether the server closed it in time.

    Args:
        half_close: close the sending side afterwards.
    """
    received = b""
    with socket.create_connection(("127.0.0.1", port), PATIENCE) as connection:
        try:
            connection.sendall(sent)
            if half_close:
                connection.shutdown(socket.SHUT_WR)
        except OSError:
            pass  # the server closed the connection before it had read everything
        until = time.monotonic() + PATIENCE
        ended = False
        while not ended and time.monotonic() < until:
            try:
                piece = connection.recv(65536)
            except TimeoutError:
                break
            except OSError:
                piece = b""
            received += piece
            ended = not piece
    return [int(status) for status in STATUS.findall(received)], ended


def mangled(seed: int, count: int) -> Iterator[bytes]:
    """Sound requests with a few bytes changed."""
    chance = random.Random(seed)
    sound = [
        b"GET /livez HTTP/1.1\r\n" + HOST + b"Connection: close\r\n\r\n",
        b"GET /v1/maps?limit=3 HTTP/1.1\r\n" + HOST + b"Accept: */*\r\nConnection: close\r\n\r\n",
        _post(b"Content-Length: 18\r\nConnection: close\r\n"),
        _post(b"Transfer-Encoding: chunked\r\nConnection: close\r\n", b"12\r\n" + BODY + b"\r\n0\r\n\r\n"),
    ]
    for _ in range(count):
        data = bytearray(chance.choice(sound))
        for _ in range(chance.choice((1, 1, 2, 5))):
            at = chance.randrange(len(data))
            what = chance.random()
            if what < 0.5:
                data[at] = chance.randrange(256)
            elif what < 0.75:
                data[at:at] = chance.choice((b"\r\n", b"\n", b"\r", b" ", b"\t", b"\0", chance.randbytes(3)))
            else:
                del data[at : at + chance.choice((1, 2, 10))]
        yield bytes(data)


def complaint(port: int, sent: bytes) -> str:
    """What was wrong with the answer to some bytes; empty if it was below 500, 501, or the connection was closed."""
    statuses, ended = spoken(port, sent)
    if any(status >= 500 and status != NOT_IMPLEMENTED for status in statuses):
        return f"answered with {statuses}: {sent[:200]!r}"
    return "" if ended else f"neither answered nor ended in {PATIENCE:.0f} s: {sent[:200]!r}"
