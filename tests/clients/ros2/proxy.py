"""A door in front of the service that can be shut: connections then hang, as when a network is gone."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress


class Door:
    """Forwards connections to a port while it is open.

    Args:
        target: the port of the service.

    Attributes:
        delay: seconds by which each piece of an answer is held back.
    """

    def __init__(self, target: int) -> None:
        self._target, self.delay = target, 0.0
        self._open = threading.Event()
        self._open.set()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._ended = False
        threading.Thread(target=self._accept, daemon=True).start()

    def shut(self) -> None:
        """Let nothing through; connections stay as they are."""
        self._open.clear()

    def open(self) -> None:
        """Let everything through again, what waited as well."""
        self._open.set()

    def close(self) -> None:
        """End it."""
        self._ended = True
        self._open.set()
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while not self._ended:
                near, _ = self._listener.accept()
                threading.Thread(target=self._forward, args=(near,), daemon=True).start()

    def _forward(self, near: socket.socket) -> None:
        with near, suppress(OSError):
            self._open.wait()
            with socket.create_connection(("127.0.0.1", self._target)) as far:
                back = threading.Thread(target=self._pump, args=(far, near, True), daemon=True)
                back.start()
                self._pump(near, far, False)
                back.join()

    def _pump(self, source: socket.socket, sink: socket.socket, answers: bool) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                self._open.wait()
                if answers:
                    time.sleep(self.delay)
                sink.sendall(data)
        with suppress(OSError):
            sink.shutdown(socket.SHUT_WR)
