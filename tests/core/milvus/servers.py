"""A real PostgreSQL, Milvus and object store on this machine, in folders of their own, for tests and trials.

    scripts/cluster                  # starts them, prints their addresses, and ends them with itself

PostgreSQL is that of the system (Debian: ``apt-get install postgresql``).  Milvus is the server of the package
``milvus`` in .venv-cluster, an old release; the object store is SeaweedFS, there as well.  All run with lower priority
than the tests.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import psycopg

from core.errors import StorageFailure
from core.milvus.collection import MilvusConnection
from tests.core.milvus.object_server import PORTS, object_store

ROOT = Path(__file__).parents[3]
MILVUS_PYTHON = ROOT / ".venv-cluster/bin/python"
START_SECONDS = 300.0
NICENESS = 10

MILVUS_SETTINGS = {"common.session.ttl": "10", "dataNode.segment.syncPeriod": "30"}
"""Other than Milvus's own, as in docker/milvus.yaml.  After a SIGKILL it searches again when what it was has expired,
in 15 s, not in 34, and when it has read its log again since it last wrote its segments down."""

# The system gives none of these to connections, so that a killed server gets its own ports again.
_FIXED_PORTS = range(20_000, 32_000)
_CONFIGURE = """
import sys
import milvus

folder, ports, *settings = sys.argv[1:]
server = milvus.default_server
server.set_base_dir(folder)
names = [name for name in server.config_keys if name.endswith("_port")]
for name, port in zip(names, ports.split(",")):
    server.config.set(name, int(port))
server.config.set("proxy_port", int(ports.rpartition(",")[2]))
for setting in settings:
    server.config.set(*setting.split("=", 1))
server.config.resolve()
milvus._initialize_data_files(server.config.base_data_dir)
"""
"""Unpacks the server and writes its configuration: the package's own starter chooses other ports at each start."""


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


_ETCD = """
listen-client-urls: http://127.0.0.1:{client}
advertise-client-urls: http://127.0.0.1:{client}
listen-peer-urls: http://127.0.0.1:{peer}
initial-advertise-peer-urls: http://127.0.0.1:{peer}
initial-cluster: default=http://127.0.0.1:{peer}
"""
"""Without it, two Milvus on one machine would want the same port."""


def fixed_ports(count: int) -> list[int]:
    """Ports that nobody listens at, and of which the system makes no use."""
    found: set[int] = set()
    while len(found) < count:
        port = random.choice(_FIXED_PORTS)
        with socket.socket() as listener, suppress(OSError):
            listener.bind(("127.0.0.1", port))
            found.add(port)
    return list(found)


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
    """The servers, and their addresses."""

    def __init__(self, folder: Path, milvus_settings: Mapping[str, str] = MILVUS_SETTINGS) -> None:
        if not MILVUS_PYTHON.exists():
            raise Missing("Milvus is not installed in .venv-cluster: scripts/test --cluster does it.")
        ports = fixed_ports(2 + PORTS)
        self.postgres_address = f"postgresql://placerec@127.0.0.1:{ports[0]}/postgres"
        self.milvus_address = f"http://127.0.0.1:{ports[1]}"
        data = [folder / "postgres", folder / "milvus", folder / "objects"]
        for path in data:
            path.mkdir(parents=True)
        folder.chmod(0o755)
        self.postgres = postgres_server(data[0], ports[0], self._ask_postgres)
        self.milvus = _milvus(data[1], ports[1], milvus_settings, self._ask_milvus)
        keep_objects, self.bucket, ask_objects = object_store(data[2], ports[2:])
        self.objects = Server(keep_objects, data[2], ask_objects)

    def _ask_postgres(self) -> None:
        psycopg.connect(self.postgres_address, connect_timeout=5).close()

    def _ask_milvus(self) -> None:
        connection = MilvusConnection(self.milvus_address, "", "", None)
        try:
            connection.check()
        finally:
            connection.close()


def postgres_server(folder: Path, port: int, answers: Callable[[], None]) -> Server:
    """A PostgreSQL with the superuser ``placerec``, who needs no password, and its data in a folder.

    Raises:
        Missing: it is not installed.
    """
    programs, files = postgres_programs(), folder / "data"
    user = "nobody" if os.getuid() == 0 else None  # PostgreSQL refuses to run as root
    if user is not None:
        shutil.chown(folder, user)
    make = [programs / "initdb", "-D", files, "-U", "placerec", "-E", "UTF8", "--locale=C", "--auth=trust", "-N"]
    subprocess.run([str(word) for word in make], cwd=folder, user=user, check=True, stdout=subprocess.DEVNULL)
    serve: list[str | Path] = [programs / "postgres", "-D", files, "-p", str(port), "-k", folder]
    return Server(serve, folder, answers, user)


def _milvus(folder: Path, port: int, settings: Mapping[str, str], answers: Callable[[], None]) -> Server:
    """A Milvus that keeps its data and its ports when it is started again."""
    others = fixed_ports(20)
    ports = ",".join(str(other) for other in (*others[3:], port))
    named = [f"{name}={value}" for name, value in settings.items()]
    subprocess.run([MILVUS_PYTHON, "-c", _CONFIGURE, folder, ports, *named], check=True)
    (folder / "etcd.yaml").write_text(_ETCD.format(client=others[1], peer=others[2]))
    variables = {
        "ETCD_CONFIG_PATH": str(folder / "etcd.yaml"),
        "DEPLOY_MODE": "STANDALONE",
        "METRICS_PORT": str(others[0]),
        "MILVUS_RUN_DIR": str(folder / "run"),
        "MILVUSCONF": str(folder / "configs"),
        "LD_LIBRARY_PATH": str(folder / "bin"),
    }
    return Server([folder / "bin/milvus", "run", "standalone"], folder, answers, variables=variables)


@contextmanager
def running_servers() -> Iterator[Servers]:
    """The servers, as long as the block runs.

    Raises:
        Missing: one is not installed.
        TimeoutError: one does not answer.
    """
    folder = Path(tempfile.mkdtemp(prefix="placerec-cluster-"))
    servers = None
    try:
        servers = Servers(folder)
        with ThreadPoolExecutor() as starting:
            list(starting.map(Server.start, (servers.postgres, servers.milvus, servers.objects)))
        yield servers
    finally:
        if servers is not None:
            servers.objects.end(signal.SIGKILL)  # it would take its time
            servers.milvus.end()
            servers.postgres.end(signal.SIGINT)
        shutil.rmtree(folder, ignore_errors=True)


def main() -> int:
    """Run the servers until Ctrl+C."""
    try:
        with running_servers() as servers:
            print(f"Milvus {servers.milvus_address}\nPostgreSQL {servers.postgres_address}", flush=True)
            bucket = servers.bucket
            print(
                f"Object store {bucket.address} at {bucket.endpoint}, {bucket.access_key}, {bucket.secret_key}",
                flush=True,
            )
            with suppress(KeyboardInterrupt):
                signal.pause()
    except (Missing, TimeoutError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
