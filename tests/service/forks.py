"""Real servers forked off a process that has imported everything: a start costs an eighth of the processor time.

What a server does after its imports is what ``placerec serve`` does; it opens its data directory, loads its encoder and
listens.  The whole start, imports included, is tested where the command itself is (``tests/service/commands``,
``tests/project``).
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from multiprocessing import popen_forkserver
from multiprocessing.context import ForkServerContext, ForkServerProcess
from multiprocessing.process import BaseProcess
from pathlib import Path

ROOT = Path(__file__).parents[2]

MODULES = (
    "torch",
    "anyio._backends._asyncio",
    "uvicorn",
    "uvloop",
    "service.app.application",
    "service.commands.serve",
    "service.telemetry.native_output",
    "service.http.server",
    "tests.service.forks",
    "tests.service.loaded",  # the last one
)

context: ForkServerContext = multiprocessing.get_context("forkserver")
context.set_forkserver_preload(list(MODULES))


class _Popen(popen_forkserver.Popen):
    """Its exit status is read once: of two threads that read it at the same time, one would find 255."""

    def __init__(self, process: BaseProcess) -> None:
        self._reading = threading.Lock()
        super().__init__(process)

    def poll(self, flag: int = os.WNOHANG) -> int | None:
        with self._reading:
            return super().poll(flag)


class _Process(ForkServerProcess):
    @staticmethod
    def _Popen(process_obj: BaseProcess) -> _Popen:  # noqa: N802
        return _Popen(process_obj)


class ForkedServer:
    """``placerec serve`` in a process that was forked off; used as :class:`subprocess.Popen` is.

    Args:
        environment: all its variables.
        log: the file that its output is appended to.
        traced: it waits until it is traced.
        files: the soft and the hard limit of its open files; None: those of this process.
    """

    def __init__(
        self, environment: Mapping[str, str], log: Path, traced: bool = False, files: tuple[int, int] | None = None
    ) -> None:
        self._process = _Process(target=_serve, args=(dict(environment), log, traced, files), daemon=True)
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    def poll(self) -> int | None:
        """The exit status, negative for a signal; None while it runs."""
        return self._process.exitcode

    def wait(self, timeout: float) -> int:
        """The exit status as soon as it has ended; :class:`subprocess.TimeoutExpired` after ``timeout`` seconds."""
        self._process.join(timeout)
        status = self._process.exitcode
        if status is None:
            raise subprocess.TimeoutExpired("placerec serve", timeout)
        return status

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


def _serve(environment: Mapping[str, str], log: Path, traced: bool, files: tuple[int, int] | None) -> None:
    if files is not None:
        resource.setrlimit(resource.RLIMIT_NOFILE, files)
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.chdir(ROOT)
    os.environ.clear()
    os.environ.update(environment)
    while traced and "TracerPid:\t0\n" in Path("/proc/self/status").read_text():
        time.sleep(0.002)
    sys.argv = ["placerec", "serve"]
    from service.commands import main

    main()
