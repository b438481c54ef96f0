"""A real PostgreSQL and a real Milvus on this machine, in folders of their own, for tests and trials.

    scripts/cluster                  # starts both, prints their addresses, and ends them with itself

PostgreSQL is that of the system (Debian: ``apt-get install postgresql``).  Milvus is the server of the package
``milvus`` in .venv-cluster, an old release.  Both run with lower priority than the tests.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psycopg

from core.errors import StorageFailure
from core.milvus.collection import Connection

ROOT = Path(__file__).parents[3]
MILVUS = ROOT / ".venv-cluster/bin/milvus-server"
START_SECONDS = 120.0
NICENESS = 10


class Missing(Exception):
    """A server is not installed; the text says how it can be."""


def postgres_programs() -> Path:
    """The folder of PostgreSQL's programs.

    Raises:
        Missing: there is none.
    """
    found = shutil.which("initdb")
    folders = [Path(found).parent] if found else sorted(Path("/usr/lib/postgresql").glob("*/bin"))
    if not folders:
        raise Missing("PostgreSQL is not installed (Debian: apt-get install postgresql).")
    return folders[-1]


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


class Server:
    """A server in a process group of its own."""

    def __init__(self, command: list[str | Path], folder: Path, answers: Callable[[], None], user: str | None) -> None:
        self._command, self._folder, self._answers, self._user = command, folder, answers, user
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it and wait until it answers.

        Raises:
            TimeoutError: it does not.
        """
        with (self._folder / "output.log").open("ab") as log:
            self._process = subprocess.Popen(
                self._command, cwd=self._folder, stdout=log, stderr=log, start_new_session=True, user=self._user,
                preexec_fn=lambda: os.nice(NICENESS) and None,
            )  # fmt: skip
        until = time.monotonic() + START_SECONDS
        while True:
            try:
                self._answers()
                return
            except (psycopg.Error, StorageFailure) as error:
                if time.monotonic() > until or self._process.poll() is not None:
                    self.end(signal.SIGKILL)
                    raise TimeoutError(f"{self._command[0]} does not answer; see {self._folder}/output.log") from error
                time.sleep(0.2)

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


class Servers:
    """Both servers, and their addresses."""

    def __init__(self, folder: Path) -> None:
        programs = postgres_programs()
        if not MILVUS.exists():
            raise Missing("Milvus is not installed in .venv-cluster: scripts/test --cluster does it.")
        user = "nobody" if os.getuid() == 0 else None  # PostgreSQL refuses to run as root
        ports = free_port(), free_port()
        self.postgres_address = f"postgresql://placerec@127.0.0.1:{ports[0]}/postgres"
        self.milvus_address = f"http://127.0.0.1:{ports[1]}"
        data = [folder / "postgres", folder / "milvus"]
        for path in data:
            path.mkdir(parents=True)
        folder.chmod(0o755)
        if user is not None:
            shutil.chown(data[0], user)
        files = data[0] / "data"
        initdb: list[str | Path] = [
            programs / "initdb",
            "-D",
            files,
            "-U",
            "placerec",
            "-E",
            "UTF8",
            "--locale=C",
            "--auth=trust",
        ]
        subprocess.run(initdb, cwd=data[0], user=user, check=True, stdout=subprocess.DEVNULL)
        serve: list[str | Path] = [programs / "postgres", "-D", files, "-p", str(ports[0]), "-k", data[0]]
        self.postgres = Server(serve, data[0], self._ask_postgres, user)
        milvus: list[str | Path] = [MILVUS, "--data", data[1] / "data", "--proxy-port", str(ports[1])]
        self.milvus = Server(milvus, data[1], self._ask_milvus, None)

    def _ask_postgres(self) -> None:
        psycopg.connect(self.postgres_address, connect_timeout=5).close()

    def _ask_milvus(self) -> None:
        Connection(self.milvus_address, "", "", None).close()


@contextmanager
def running_servers() -> Iterator[Servers]:
    """Both servers, as long as the block runs.

    Raises:
        Missing: one is not installed.
        TimeoutError: one does not answer.
    """
    folder = Path(tempfile.mkdtemp(prefix="placerec-cluster-"))
    servers = None
    try:
        servers = Servers(folder)
        servers.postgres.start()
        servers.milvus.start()
        yield servers
    finally:
        if servers is not None:
            servers.milvus.end()
            servers.postgres.end(signal.SIGINT)
        shutil.rmtree(folder, ignore_errors=True)


def main() -> int:
    """Run both servers until Ctrl+C."""
    try:
        with running_servers() as servers:
            print(f"Milvus {servers.milvus_address}\nPostgreSQL {servers.postgres_address}", flush=True)
            with suppress(KeyboardInterrupt):
                signal.pause()
    except (Missing, TimeoutError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
