"""A service process to measure."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np

ROOT = Path(__file__).parents[1]
START_SECONDS = 300.0
POLL_SECONDS = 0.1
"""From one look at whether a service is ready to the next; a hundred a second would take half of its start's time."""
BATCH = 64


@dataclass
class Process:
    """A running service.

    ready: seconds from its start to the first 200 of ``/readyz``.
    """

    client: httpx.Client
    pid: int
    ready: float

    def memory(self) -> float:
        """Resident memory, in MB (10^6 bytes)."""
        return memory(self.pid)

    def peak_memory(self) -> float:
        """The most memory that it has had resident, in MB (10^6 bytes)."""
        return peak_memory(self.pid)

    def processor_time(self) -> float:
        """The processor time that it has had, in seconds."""
        return processor_time(self.pid)

    def open_files(self) -> int:
        """How many file descriptors it has open."""
        return len(list(Path(f"/proc/{self.pid}/fd").iterdir()))


def memory(pid: int) -> float:
    """Resident memory of a process, in MB (10^6 bytes); 0 if it has ended."""
    return _status(pid, "VmRSS")


def peak_memory(pid: int) -> float:
    """The most memory that a process has had resident, in MB (10^6 bytes); 0 if it has ended."""
    return _status(pid, "VmHWM")


def processor_time(pid: int) -> float:
    """The processor time that a process has had, in seconds; 0 if it has ended."""
    fields = _stat(pid)
    return sum(int(field) for field in fields[11:13]) / os.sysconf("SC_CLK_TCK") if fields else 0.0


def total_processor_time(pid: int) -> float:
    """The processor time of a process and of those that it started and that still run, in seconds."""
    return sum(map(processor_time, {pid, *descendants(pid)}))


def descendants(pid: int) -> set[int]:
    """The processes that a process has started, and those that these have."""
    parents = {int(path.name): _stat(int(path.name)) for path in Path("/proc").iterdir() if path.name.isdigit()}
    children: dict[int, list[int]] = {}
    for child, fields in parents.items():
        if fields:
            children.setdefault(int(fields[1]), []).append(child)
    found, waiting = set(), [pid]
    while waiting:
        some = children.get(waiting.pop(), [])
        found.update(some)
        waiting += some
    return found


def _stat(pid: int) -> list[str]:
    """The fields of a process from its state on; none if it has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def _status(pid: int, name: str) -> float:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    kilobytes = next((line.split()[1] for line in lines if line.startswith(f"{name}:")), "0")
    return int(kilobytes) * 1024 / 1e6


@contextmanager
def service(
    data_dir: Path,
    threads: int = 0,
    settings: Mapping[str, object] | None = None,
    log: Path = Path("/dev/stderr"),
    port: int = 0,
) -> Iterator[Process]:
    """``placerec serve`` on a directory, until the block ends.

    Args:
        threads: of a forward pass, 0 for torch's choice.
        settings: others, by their variables without the prefix.
        log: where it logs to.
        port: that it listens on; 0 for a free one.
    """
    if not port:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
    own = {"DATA_DIR": data_dir, "THREADS": threads, "LOG_LEVEL": "warning", **(settings or {})}
    environment = {**os.environ, **{f"PLACEREC_{name}": str(value) for name, value in own.items()}}
    command = [sys.executable, "-m", "service.commands", "serve", "--host", "127.0.0.1", "--port", str(port)]
    began = time.monotonic()
    with log.open("ab") as opened:
        process = subprocess.Popen(command, cwd=ROOT, env=environment, stderr=opened)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60) as client:
            yield Process(client, process.pid, _wait(client, process, began))
    finally:
        process.terminate()
        process.wait(60)


def _wait(client: httpx.Client, process: subprocess.Popen[bytes], began: float) -> float:
    while time.monotonic() - began < START_SECONDS and process.poll() is None:
        try:
            if client.get("/readyz").status_code == 200:
                return time.monotonic() - began
        except httpx.TransportError:
            pass
        time.sleep(POLL_SECONDS)
    raise RuntimeError("the service did not become ready")


def median(values: Sequence[float]) -> float:
    """The median of a list."""
    return float(np.median(values))
