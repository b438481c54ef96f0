"""Several nodes of Ray on this machine, in a process of their own, so that they can be killed as machines fail.

    python -m tests.service.ray_serve.nodes PORT

starts a head that computes nothing, then a node for each line ``node CPUS`` of its input, or a new head for ``head``.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Self

from benchmarks.process import descendants

STORE_BYTES = 80_000_000

ATTEMPTS = 8
"""A node gives up if its agent is not there after fifteen seconds, which a busy machine may well need to start it."""


@dataclass(frozen=True)
class Node:
    """One machine of a cluster, as far as Ray knows."""

    pids: tuple[int, ...]

    def processes(self) -> set[int]:
        """All of them, with those that encode."""
        return {*self.pids}.union(*(descendants(pid) for pid in self.pids))

    def kill(self) -> None:
        """End all its processes at once, as a machine does that loses its power."""
        for pid in self.processes():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


class Nodes:
    """A head of Ray that computes nothing, and the nodes that are added; all end with the block."""

    def __init__(self) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.address = f"127.0.0.1:{probe.getsockname()[1]}"
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.service.ray_serve.nodes", self.address.rpartition(":")[2]],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[3],
        )
        self._nodes = [self._read()]

    def start_head(self) -> None:
        """Start another head at the same address; what the one before it knew is lost."""
        self._nodes[0] = self._ask("head")

    def add(self, cpus: int) -> Node:
        """Start a node."""
        self._nodes.append(node := self._ask(f"node {cpus}"))
        return node

    def kill(self) -> None:
        """End the head and all nodes at once."""
        for node in self._nodes:
            node.kill()

    def _ask(self, command: str) -> Node:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{command}\n")
        self._process.stdin.flush()
        return self._read()

    def _read(self) -> Node:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                return Node(tuple(json.loads(line)["pids"]))
        raise RuntimeError("no node of Ray starts")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.kill()
        self._process.kill()
        self._process.wait()


def main(port: int) -> None:
    """Start nodes as the input says."""
    from service.ray_serve.cluster import prepare_environment, start_no_dashboards

    prepare_environment(own=True, local=True)
    start_no_dashboards()
    import ray._private.utils
    from ray.cluster_utils import Cluster

    # Nodes without a dashboard start sooner.
    ray._private.utils.get_dashboard_dependency_error = lambda: ImportError("not needed")
    made = Cluster()
    shared: dict[str, Any] = {
        "include_dashboard": False,
        "include_log_monitor": False,
        "no_monitor": True,
        "object_store_memory": STORE_BYTES,
    }

    def head() -> Any:
        made.head_node = None
        return made.add_node(num_cpus=0, gcs_server_port=port, **shared)

    started: set[int] = set()

    def start(make: Callable[[], Any]) -> None:
        for attempt in range(ATTEMPTS):
            try:
                node = make()
            except Exception:
                if attempt == ATTEMPTS - 1:
                    raise
                running = started.union(*(descendants(pid) for pid in started))
                Node(tuple(descendants(os.getpid()) - running)).kill()
            else:
                pids = [one.process.pid for some in node.all_processes.values() for one in some]
                started.update(pids)
                print(json.dumps({"pids": pids}), flush=True)
                return

    start(head)
    for line in sys.stdin:
        command, *rest = line.split()
        start(head if command == "head" else partial(made.add_node, num_cpus=int(rest[0]), **shared))


if __name__ == "__main__":
    main(int(sys.argv[1]))
