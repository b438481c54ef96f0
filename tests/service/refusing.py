"""A server that refuses every request, and writes down the method and the path of each as they arrive."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any

Seen = list[tuple[str, str]]
"""Method and path, without the query string, of each request."""


class Refusing(BaseHTTPRequestHandler):
    """Answers every request with a problem, after its method and path are noted."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    seen: list[tuple[str, str]]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("do_"):
            return self._refuse
        raise AttributeError(name)

    def _refuse(self) -> None:
        self.seen.append((self.command, self.requestline.split(" ")[1].partition("?")[0]))
        if self.headers.get("Transfer-Encoding") == "chunked":
            while size := int(self.rfile.readline(), 16):
                self.rfile.read(size + 2)
            self.rfile.readline()
        self.rfile.read(int(self.headers.get("Content-Length") or 0))
        body = json.dumps({"type": "urn:placerec:problem:key-refused", "status": 401}).encode()
        self.send_response(401)
        self.send_header("Content-Type", "application/problem+json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Write nothing."""


@contextmanager
def refusing_server() -> Iterator[tuple[str, Seen]]:
    """The URL of such a server, and what arrived there."""
    seen: Seen = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Noting", (Refusing,), {"seen": seen}))
    thread = Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}", seen
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
