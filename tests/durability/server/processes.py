"""Starts servers that are going to be killed."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import httpx

from tests.durability.storage.processes import REPOSITORY
from tests.service.server import free_port

START_SECONDS = 300.0
"""The machine may be busy with other things."""


class ServerProcess:
    """``placerec serve`` in a process that was forked off (:mod:`tests.durability.server.forks`)."""

    def __init__(self, number: int, port: int, log: Path) -> None:
        self.number, self.log = number, log
        self.client = httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=120)
        self._handle: int | None = None
        with suppress(ProcessLookupError):
            self._handle = os.pidfd_open(number)

    def is_running(self) -> bool:
        """Whether the process runs."""
        return self._handle is not None and not select.select([self._handle], [], [], 0)[0]

    def wait(self) -> Self:
        """Wait until the server is ready."""
        until = time.monotonic() + START_SECONDS
        while time.monotonic() < until:
            assert self.is_running(), f"the server has ended:\n{self.log.read_text()[-4000:]}"
            with suppress(httpx.TransportError):
                if self.client.get("/readyz").status_code == 200:
                    return self
            time.sleep(0.02)
        raise AssertionError(f"the server is not ready:\n{self.log.read_text()[-4000:]}")

    def kill(self) -> None:
        """Send SIGKILL and wait for the end; more than once does no harm."""
        if self._handle is None:
            return
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._handle, signal.SIGKILL)
        assert select.select([self._handle], [], [], 60)[0], "the process does not end"

    def close(self) -> None:
        """Kill the server and close the connections."""
        self.kill()
        self.client.close()
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None


class ServerProcesses:
    """Starts servers, each in little more time than it takes to be ready."""

    def __init__(self, folder: Path) -> None:
        """Import all that a server needs, once.

        Args:
            folder: for what the servers write to standard error.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self._log = folder / "log.jsonl"
        with self._log.open("ab") as log:
            self._parent = subprocess.Popen(
                [sys.executable, "-m", "tests.durability.server.forks"],
                cwd=REPOSITORY,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
            )
        assert self._parent.stdout is not None
        assert self._parent.stdout.readline() == b"ready\n", self._log.read_text()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._parent.stdin is not None and self._parent.stdout is not None
        self._parent.stdin.close()
        self._parent.wait(60)
        self._parent.stdout.close()

    def begin(self, settings: Mapping[str, object], traced: bool = False) -> ServerProcess:
        """Start a server with these settings and a port of its own.

        Args:
            traced: the server waits until it is traced.
        """
        assert self._parent.stdin is not None and self._parent.stdout is not None
        port = free_port()
        own = {"host": "127.0.0.1", "port": port, **settings}
        environment = {f"PLACEREC_{name.upper()}": str(value) for name, value in own.items()}
        wanted = {"environment": environment, "log": str(self._log), "traced": traced}
        self._parent.stdin.write(json.dumps(wanted).encode() + b"\n")
        self._parent.stdin.flush()
        return ServerProcess(int(self._parent.stdout.readline()), port, self._log)
