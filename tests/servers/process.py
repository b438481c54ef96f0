"""A server on this machine in a process group of its own, with lower priority than the tests."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import psycopg

from core.errors import StorageFailure

START_SECONDS = 300.0
NICENESS = 10

# The system gives none of these to connections, so that a killed server gets its own ports again.
_FIXED_PORTS = range(20_000, 32_000)


class Missing(Exception):
    """A server is not installed; the text says how it can be."""


_given: set[int] = set()  # ports of servers that may not listen yet


def fixed_ports(count: int) -> list[int]:
    """Ports that nobody listens at, that were not given before, and of which the system makes no use."""
    found: list[int] = []
    while len(found) < count:
        port = random.choice(_FIXED_PORTS)
        with socket.socket() as listener, suppress(OSError):
            listener.bind(("127.0.0.1", port))
            if port not in _given:
                _given.add(port)
                found.append(port)
    return found


class Server:
    """A server in a process group of its own."""

    def __init__(
        self,
        command: list[str | Path],
        folder: Path,
        answers: Callable[[], None],
        user: str | None = None,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        self._command, self._folder, self._answers, self._user = command, folder, answers, user
        self._variables = {**os.environ, **(variables or {})}
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def process_id(self) -> int:
        """Of its first process, while it runs."""
        assert self._process is not None, "it does not run"
        return self._process.pid

    def start(self) -> None:
        """Start it and wait until it answers.

        Raises:
            TimeoutError: it does not.
        """
        with (self._folder / "output.log").open("ab") as log:
            self._process = subprocess.Popen(
                self._command, cwd=self._folder, stdout=log, stderr=log, start_new_session=True, user=self._user,
                env=self._variables, preexec_fn=lambda: os.nice(NICENESS) and None,
            )  # fmt: skip
        until = time.monotonic() + START_SECONDS
        while True:
            try:
                self._answers()
                return
            except (psycopg.Error, StorageFailure) as error:
                if time.monotonic() > until or self._process.poll() is not None:
                    ended = self._process.poll()
                    self.end(signal.SIGKILL)
                    said = (self._folder / "output.log").read_text(errors="replace")[-2000:]
                    text = f"{self._command[0]} does not answer ({error}), or has ended ({ended}); it said: …{said}"
                    raise TimeoutError(text) from error
                time.sleep(0.2)

    @contextmanager
    def silenced(self) -> Iterator[Sequence[int]]:
        """Let all its processes, whose ids are given, stand still as long as the block runs."""
        processes = [self.process_id]
        try:
            for process in processes:  # it grows meanwhile; whoever stands still starts no other
                _stop(process)
                processes += _children(process)
            yield processes
        finally:
            for process in processes:
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGCONT)

    def stall(self, seconds: float) -> None:
        """Let it stand still for some seconds."""
        with self.silenced():
            time.sleep(seconds)

    def kill(self) -> None:
        """End all its processes by SIGKILL at once, those too that have a group of their own, as PostgreSQL's."""
        with self.silenced() as processes:
            for process in reversed(processes):
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            while any(state_of(process)[0] not in "XZ" for process in processes):
                time.sleep(0.001)
        self.end(signal.SIGKILL)

    def has_ended(self, within: float) -> bool:
        """Whether it ends by itself within some seconds."""
        assert self._process is not None, "it does not run"
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(within)
        return self._process.poll() is not None

    def end(self, by: signal.Signals = signal.SIGTERM) -> None:
        """End it, gently or by SIGKILL, and wait until it has ended."""
        process, self._process = self._process, None
        if process is None:
            return
        with suppress(ProcessLookupError):
            os.killpg(process.pid, by)
        with suppress(subprocess.TimeoutExpired):
            process.wait(20)
        with suppress(ProcessLookupError):  # what Milvus's own starter leaves behind
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _stop(process: int) -> None:
    """Let a process stand still, and wait until it does, or is gone."""
    with suppress(ProcessLookupError):
        os.kill(process, signal.SIGSTOP)
    while state_of(process)[0] not in "TXZ":
        time.sleep(0.001)


def _children(process: int) -> list[int]:
    """The processes that one has started and that have not ended."""
    found = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]
    return [one for one in found if (state := state_of(one))[0] != "Z" and int(state[1]) == process]


def state_of(process: int) -> tuple[str, str]:
    """The letter of a process's state, X if it is gone, and the id of the one that started it."""
    with suppress(OSError):
        state, parent = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[:2]
        return state, parent
    return "X", "0"
