"""A door before a server: as long as it is shut, the server cannot be reached."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from urllib.parse import urlsplit

from tests.service.server import free_port


class Door:
    """Listens at a port of its own, and passes all bytes on to a server and back; it is shut at first."""

    def __init__(self, address: str) -> None:
        there = urlsplit(address)
        assert there.hostname is not None and there.port is not None
        self._there, self._port = (there.hostname, there.port), free_port()
        self.address = f"{there.scheme}://127.0.0.1:{self._port}"
        self._listener: socket.socket | None = None
        self._passing: list[socket.socket] = []

    def open(self) -> None:
        """Let everything through from now on."""
        listener = self._listener = socket.create_server(("127.0.0.1", self._port), reuse_port=True)
        threading.Thread(target=self._listen, args=(listener,), daemon=True).start()

    def shut(self) -> None:
        """Refuse connections, and break those that there are."""
        listener, self._listener = self._listener, None
        passing, self._passing = self._passing, []
        for one in [*passing, *([] if listener is None else [listener])]:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _listen(self, listener: socket.socket) -> None:
        while self._listener is listener:
            try:
                near, _ = listener.accept()
                far = socket.create_connection(self._there)
            except OSError:
                return
            self._passing += [near, far]
            for source, target in ((near, far), (far, near)):
                threading.Thread(target=self._pass, args=(source, target), daemon=True).start()

    def _pass(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                target.sendall(data)
        for one in (source, target):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
