"""A real Milvus on this machine: the server of the package ``milvus`` in .venv-cluster, an old release."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from core.index.milvus import Milvus
from tests.servers.process import Missing, Server, fixed_ports

ROOT = Path(__file__).parents[2]
MILVUS_PYTHON = ROOT / ".venv-cluster/bin/python"

MILVUS_SETTINGS = {
    "common.session.ttl": "40",
    "dataNode.segment.syncPeriod": "30",
    "proxy.timeTickInterval": "50",
}
"""Other than Milvus's own, as in docker/milvus.yaml.  Its sessions outlive a stall of 20 s.  After a SIGKILL it
searches again when they have expired, and when it has read its log again since it last wrote its segments down."""

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


_ETCD = """
listen-client-urls: http://127.0.0.1:{client}
advertise-client-urls: http://127.0.0.1:{client}
listen-peer-urls: http://127.0.0.1:{peer}
initial-advertise-peer-urls: http://127.0.0.1:{peer}
initial-cluster: default=http://127.0.0.1:{peer}
"""
"""Without it, two Milvus on one machine would want the same port."""


class MilvusServer:
    """A Milvus in a folder of its own.

    address, process: its own.
    token, certificate: by which its administrator comes in.
    """

    certificate: str | None

    def __init__(self, folder: Path, settings: Mapping[str, str] = MILVUS_SETTINGS) -> None:
        if not MILVUS_PYTHON.exists():
            raise Missing("Milvus is not installed in .venv-cluster: scripts/test --cluster does it.")
        (port,) = fixed_ports(1)
        self.address, self.token, self.certificate = f"http://127.0.0.1:{port}", "", None
        self.process = _server(folder, port, settings, self.ask)

    def ask(self) -> None:
        """Raise unless it answers."""
        asking = Milvus(self.address, self.token, certificate=self.certificate)
        try:
            asking.check()
        finally:
            asking.close()


def _server(folder: Path, port: int, settings: Mapping[str, str], answers: Callable[[], None]) -> Server:
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
def running_milvus() -> Iterator[MilvusServer]:
    """A Milvus, as long as the block runs.

    Raises:
        Missing: it is not installed.
        TimeoutError: it does not answer.
    """
    folder = Path(tempfile.mkdtemp(prefix="placerec-milvus-"))
    server = None
    try:
        server = MilvusServer(folder)
        server.process.start()
        yield server
    finally:
        if server is not None:
            server.process.end()
        shutil.rmtree(folder, ignore_errors=True)
