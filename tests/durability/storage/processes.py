"""Starts processes that drive the storage layer and are going to be killed, and talks to them."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tests.durability.model import Lost

REPOSITORY = Path(__file__).parents[3]
PATIENCE = 120.0
"""Seconds after which an answer that does not come is a failure."""


class ProcessEnded(Exception):
    """The process ended before it answered."""


class Connection:
    """One worker's connection to a process."""

    def __init__(self, connection: socket.socket) -> None:
        connection.settimeout(PATIENCE)
        self._connection, self._rest = connection, b""

    def begin(self) -> None:
        """Let a process go on that waits for its tracer."""
        self._connection.sendall(b"\n")

    def send(self, operation: dict[str, Any]) -> None:
        """Send an operation.

        Raises:
            ProcessEnded.
        """
        try:
            self._connection.sendall(json.dumps(operation).encode() + b"\n")
        except (BrokenPipeError, ConnectionResetError) as error:
            raise ProcessEnded from error

    def answer(self) -> dict[str, Any]:
        """Receive the answer; one that was sent before the process ended counts.

        Raises:
            ProcessEnded.
        """
        while b"\n" not in self._rest:
            try:
                more = self._connection.recv(1 << 20)
            except ConnectionResetError as error:
                raise ProcessEnded from error
            if not more:
                raise ProcessEnded
            self._rest += more
        line, _, self._rest = self._rest.partition(b"\n")
        found: dict[str, Any] = json.loads(line.removeprefix(b"ack "))
        if "failure" in found:
            raise Lost(found["failure"])
        return found

    def ask(self, operation: dict[str, Any]) -> dict[str, Any]:
        """Send an operation and wait for its answer."""
        self.send(operation)
        return self.answer()

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


class StorageProcess:
    """One process and its connections, one for each worker."""

    def __init__(self, number: int, connections: list[Connection]) -> None:
        self.number, self.connections = number, connections

    def kill(self) -> None:
        """Send SIGKILL; more than once does no harm."""
        with suppress(ProcessLookupError):
            os.kill(self.number, signal.SIGKILL)

    def close(self) -> None:
        """Close the connections, which ends the process, and wait for its end."""
        for connection in self.connections:
            connection.close()
        self.wait()

    def wait(self) -> None:
        """Wait for the end of the process, which holds the data directory until then."""
        handle = None
        try:
            handle = os.pidfd_open(self.number)
            assert select.select([handle], [], [], PATIENCE)[0], "the process does not end"
        except ProcessLookupError:
            return
        finally:
            if handle is not None:
                os.close(handle)


class StorageProcesses:
    """Starts processes that drive the storage layer, in a few milliseconds each."""

    def __init__(self, folder: Path, workers: int = 1, unsynced: str | None = None) -> None:
        """Import all that such a process needs, once.

        Args:
            folder: for the socket; its path must be short.
            workers: of each process.
            unsynced: what the processes leave unsynced (``driver.UNSYNCED``), for a test of the harness.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self._workers, self._address = workers, folder / "socket"
        self._address.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(self._address))
        self._listener.listen(16)
        self._listener.settimeout(PATIENCE)
        command = [sys.executable, "-m", "tests.durability.storage.driver", *([unsynced] if unsynced else [])]
        self._log = (folder / "log").open("ab")
        self._parent = subprocess.Popen(
            command, cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._listener.close()
        assert self._parent.stdin is not None and self._parent.stdout is not None
        self._parent.stdin.close()
        self._parent.wait(PATIENCE)
        self._parent.stdout.close()
        self._log.close()

    def begin(self, directory: Path, waiting: bool = False) -> StorageProcess:
        """Start a process with a data directory.

        Args:
            waiting: the process opens the directory only after ``connections[0].begin()``.
        """
        assert self._parent.stdin is not None and self._parent.stdout is not None
        self._parent.stdin.write(f"{directory} {self._address} {self._workers}\n".encode())
        self._parent.stdin.flush()
        number = int(self._parent.stdout.readline())
        connections: dict[int, Connection] = {}
        while len(connections) < self._workers:
            connection, _ = self._listener.accept()
            connections[int(connection.recv(2))] = Connection(connection)
        process = StorageProcess(number, [connections[worker] for worker in range(self._workers)])
        if not waiting:
            process.connections[0].begin()
        return process
