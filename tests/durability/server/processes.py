"""Starts servers that are going to be killed."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Self

import httpx

from tests.service.forks import ForkedServer
from tests.service.server import reserved

START_SECONDS = 300.0
"""The machine may be busy with other things."""


class ServerProcess:
    """``placerec serve`` in a process that was forked off (:mod:`tests.service.forks`)."""

    def __init__(self, process: ForkedServer, reservation: socket.socket, log: Path) -> None:
        self.number, self.log = process.pid, log
        self._reservation, port = reservation, reservation.getsockname()[1]
        self.client = httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=120)
        self._process = process

    def wait(self) -> Self:
        """Wait until the server is ready."""
        until = time.monotonic() + START_SECONDS
        while time.monotonic() < until:
            assert self._process.poll() is None, f"the server has ended:\n{self.log.read_text()[-4000:]}"
            with suppress(httpx.TransportError):
                if self.client.get("/readyz").status_code == 200:
                    return self
            time.sleep(0.02)
        raise AssertionError(f"the server is not ready:\n{self.log.read_text()[-4000:]}")

    def kill(self) -> None:
        """Send SIGKILL and wait for the end; more than once does no harm."""
        self._process.kill()
        self._process.wait(60)

    def close(self) -> None:
        """Kill the server and close the connections."""
        self.kill()
        self.client.close()
        self._reservation.close()


class ServerProcesses:
    """Starts servers, each in little more time than it takes to be ready."""

    def __init__(self, folder: Path) -> None:
        """Prepare to start servers.

        Args:
            folder: for what the servers write to standard error.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self._log = folder / "log.jsonl"

    def begin(self, settings: Mapping[str, object], traced: bool = False) -> ServerProcess:
        """Start a server with these settings and a port of its own.

        Args:
            traced: the server waits until it is traced.
        """
        reservation = reserved()
        own = {"host": "127.0.0.1", "port": reservation.getsockname()[1], **settings}
        environment = os.environ | {f"PLACEREC_{name.upper()}": str(value) for name, value in own.items()}
        return ServerProcess(ForkedServer(environment, self._log, traced), reservation, self._log)
