"""Bytes over bare sockets, and what is counted of them."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Callable
from pathlib import Path

from tests.service.server import Server


def opened(server: Server, address: str = "127.0.0.1", receive_buffer: int | None = None) -> socket.socket:
    """A connection that comes from one of this machine's many addresses."""
    made = socket.socket()
    if receive_buffer is not None:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
    made.bind((address, 0))
    made.settimeout(30)
    made.connect(("127.0.0.1", server.port))
    return made


def get(path: str, *lines: str) -> bytes:
    """A GET request."""
    return "\r\n".join([f"GET {path} HTTP/1.1", "Host: localhost", *lines, "", ""]).encode()


def post(path: str, body: bytes, length: int | None = None, kind: str = "image/jpeg") -> bytes:
    """A POST request; ``length`` may promise more than the body has."""
    size = len(body) if length is None else length
    start = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: {kind}\r\nContent-Length: {size}\r\n\r\n"
    return start.encode() + body


def rest(connection: socket.socket) -> bytes:
    """All that comes until the other side closes."""
    found = b""
    try:
        while piece := connection.recv(65536):
            found += piece
    except ConnectionError:
        pass
    connection.close()
    return found


def answer(connection: socket.socket) -> tuple[int, bytes]:
    """Status and head of the next answer, which is read to its end."""
    found = b""
    while b"\r\n\r\n" not in found:
        piece = connection.recv(65536)
        assert piece, f"closed after {found!r}"
        found += piece
    start, _, body = found.partition(b"\r\n\r\n")
    length = re.search(rb"(?i)\r\ncontent-length: *(\d+)", start)
    while length is not None and len(body) < int(length[1]):
        piece = connection.recv(65536)
        assert piece, f"closed after {found!r}"
        body += piece
    return int(start.split(b" ", 2)[1]), start


def open_files(server: Server) -> int:
    """How many descriptors the server has."""
    return len(list(Path(f"/proc/{server.process.pid}/fd").iterdir()))


def ended(server: Server, reason: str) -> float:
    """How many connections it has ended for a reason."""
    name = f'placerec_connections_ended_total{{reason="{reason}"}} '
    found = [line for line in server.client.get("/metrics").text.splitlines() if line.startswith(name)]
    return float(found[0].rsplit(" ", 1)[1]) if found else 0.0


def eventually(truth: Callable[[], bool], seconds: float = 30, every: float = 0.05) -> bool:
    """Whether it comes true."""
    until = time.monotonic() + seconds
    while not truth():
        if time.monotonic() > until:
            return False
        time.sleep(every)
    return True
