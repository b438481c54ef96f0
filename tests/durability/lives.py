"""Processes that are begun to be killed, and the talk with them."""

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

REPOSITORY = Path(__file__).parents[2]
PATIENCE = 120.0
"""Seconds after which an answer that does not come is a failure."""


class Dead(Exception):
    """The process was killed before it answered."""


class Voice:
    """One worker's connection to a process."""

    def __init__(self, connection: socket.socket) -> None:
        connection.settimeout(PATIENCE)
        self._connection, self._rest = connection, b""

    def begin(self) -> None:
        """Let the process go on that waits for its tracer."""
        self._connection.sendall(b"\n")

    def send(self, operation: dict[str, Any]) -> None:
        """Let an operation begin.

        Raises:
            Dead.
        """
        try:
            self._connection.sendall(json.dumps(operation).encode() + b"\n")
        except (BrokenPipeError, ConnectionResetError) as error:
            raise Dead from error

    def answer(self) -> dict[str, Any]:
        """What became of it; an answer that was sent before the process died counts.

        Raises:
            Dead.
        """
        while b"\n" not in self._rest:
            try:
                more = self._connection.recv(1 << 20)
            except ConnectionResetError as error:
                raise Dead from error
            if not more:
                raise Dead
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
        """Hang up."""
        self._connection.close()


class Life:
    """One process."""

    def __init__(self, number: int, voices: list[Voice]) -> None:
        self.number, self.voices = number, voices

    def kill(self) -> None:
        """SIGKILL, as often as one likes."""
        with suppress(ProcessLookupError):
            os.kill(self.number, signal.SIGKILL)

    def close(self) -> None:
        """Hang up, which ends the process, and wait until it is gone."""
        for voice in self.voices:
            voice.close()
        self.wait()

    def wait(self) -> None:
        """Until it is gone: it holds the data directory before."""
        handle = None
        try:
            handle = os.pidfd_open(self.number)
            assert select.select([handle], [], [], PATIENCE)[0], "the process does not end"
        except ProcessLookupError:
            return
        finally:
            if handle is not None:
                os.close(handle)


class Lives:
    """Begins processes that drive the storage layer, in a few milliseconds each."""

    def __init__(self, folder: Path, workers: int = 1, unsynced: str | None = None) -> None:
        """Of processes with so many workers each.

        Args:
            folder: for the socket; its path must be short.
            unsynced: what they leave unsynced (``storage_process.UNSYNCED``), to be found out.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self._workers, self._address = workers, folder / "socket"
        self._address.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(self._address))
        self._listener.listen(16)
        self._listener.settimeout(PATIENCE)
        command = [sys.executable, "-m", "tests.durability.storage_process", *([unsynced] if unsynced else [])]
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

    def begin(self, directory: Path, waiting: bool = False) -> Life:
        """One more process, with a data directory.

        Args:
            waiting: it opens the directory when its first voice says so.
        """
        assert self._parent.stdin is not None and self._parent.stdout is not None
        self._parent.stdin.write(f"{directory} {self._address} {self._workers}\n".encode())
        self._parent.stdin.flush()
        number = int(self._parent.stdout.readline())
        voices: dict[int, Voice] = {}
        while len(voices) < self._workers:
            connection, _ = self._listener.accept()
            voices[int(connection.recv(2))] = Voice(connection)
        life = Life(number, [voices[worker] for worker in range(self._workers)])
        if not waiting:
            life.voices[0].begin()
        return life
