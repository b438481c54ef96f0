"""``placerec`` forked off a process that has imported everything, for scripts of shells that run many commands.

A small script takes the command's place: it hands its words, folder, environment and open files over, and ends as the
command does.  What the command does after its imports is what ``placerec`` does; the installed one is tested in
``tests/service/commands/test_serve.py`` and ``tests/project``.
"""

from __future__ import annotations

import importlib
import json
import os
import socket
import sys
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

from tests.service.forks import context

MODULES = (
    "lab.evaluation.report",
    "onnx",
    "rosbags.highlevel",
    "service.commands.bench",
)
"""What is imported besides what the servers' process has."""

SCRIPT = """#!{python} -IS
import json, os, socket, sys
told = json.dumps([sys.argv[1:], os.getcwd(), dict(os.environ)]).encode()
with socket.socket(socket.AF_UNIX) as there:
    there.connect({address!r})
    socket.send_fds(there, [len(told).to_bytes(4, "big")], [0, 1, 2])
    there.sendall(told)
    status = there.recv(1)
sys.exit(status[0] if status else "the process of the commands has ended")
"""


class ForkedCommands:
    """A script named ``placerec`` in a folder, and the process that does its work."""

    def __init__(self, folder: Path) -> None:
        address, self.script = f"\0placerec-{uuid4()}", folder / "placerec"  # a path might be too long for a socket
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind(address)
            listening.listen()
            self._process = context.Process(target=_listen, args=(listening,))
            self._process.start()
        self.script.write_text(SCRIPT.format(python=sys.executable, address=address))
        self.script.chmod(0o755)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()


def _listen(listening: socket.socket) -> None:
    """Fork one child a command, until killed."""
    for name in MODULES:
        importlib.import_module(name)
    while True:
        connection, _ = listening.accept()
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:  # those that have ended
                pass
        if os.fork() == 0:
            listening.close()
            _answer(connection)
        connection.close()


def _answer(connection: socket.socket) -> None:
    """Run one command in a child, and tell its status."""
    size, descriptors, _, _ = socket.recv_fds(connection, 4, 3)
    with connection.makefile("rb") as told:
        words, folder, environment = json.loads(told.read(int.from_bytes(size, "big")))
    if child := os.fork():
        for descriptor in descriptors:
            os.close(descriptor)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        connection.sendall(bytes([status % 256 if status >= 0 else 128 - status]))
        os._exit(0)
    connection.close()
    for number, descriptor in enumerate(descriptors):
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = ["placerec", *words]
    sys.stdin = open(0)  # noqa: SIM115 — multiprocessing has closed this process's own
    from service.commands import main

    main()
