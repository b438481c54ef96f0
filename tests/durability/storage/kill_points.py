"""A fixed run of the storage layer, killed at every call by which it writes: once before each, for each kind of call.

What was written by one call is on disk, for all that a killed process can tell, when the next one begins; so a kill
before every call is also a kill after every one, the making of a file by opening it included.  These are the steps of a
COMMIT, of the transaction that deletes what no place shows any more, of closing a file, of a checkpoint and of
rewriting a file, and of making, importing, publishing and deleting a map.
"""

from __future__ import annotations

import re
import subprocess
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from tests.durability.model import Lost
from tests.durability.storage.kills import Worker, expect_erased
from tests.durability.storage.power_cuts import attach
from tests.durability.storage.processes import ProcessEnded, StorageProcesses
from tests.syscalls import strace

CALLS = ("pwrite64", "write", "fsync", "fdatasync", "ftruncate", "rename", "unlink", "unlinkat", "mkdir", "rmdir")
OPERATIONS = 40

Point = tuple[str, int]
"""A call and its number, from 1 on, among those of its kind in a thread."""


@dataclass
class PointTally:
    """Counts of the points that were tried."""

    points: int = 0
    killed: int = 0  # the others were not met: threads do not run alike twice
    operations: int = 0


def points(processes: StorageProcesses, folder: Path, seed: object) -> list[Point]:
    """Every point of the run: the most calls of each kind that any of its threads made.

    Raises:
        Lost: it did not go as it must.
    """
    trace = folder / "trace"
    tracer = [strace() or "strace", "-f", "-e", f"trace={','.join(CALLS)}", "-o", str(trace)]
    _run(processes, folder / "whole", tracer, seed, may_be_killed=False)
    counted = Counter(
        (found[1], found[2]) for line in trace.open() if (found := re.match(r"(\d+) +(\w+)\(", line)) is not None
    )
    most = {call: max((n for (_, name), n in counted.items() if name == call), default=0) for call in CALLS}
    return [(call, number) for call in CALLS for number in range(1, most[call] + 1)]


def kill_at(processes: StorageProcesses, folder: Path, seed: object, point: Point) -> tuple[bool, int]:
    """Run until the point and compare; whether the point was reached, and how many operations were begun.

    Raises:
        Lost: something that was acknowledged is not there, or something is half there.
    """
    call, number = point
    tracer = [strace() or "strace", "-f", "-o", "/dev/null", "-e", f"trace={call}"]
    tracer += ["-e", f"inject={call}:signal=KILL:when={number}"]
    directory = folder / f"{call}-{number}"
    worker, met = _run(processes, directory, tracer, seed, may_be_killed=True)
    expect_erased(directory, *worker.candidates)
    process = processes.begin(directory)
    try:
        worker.settle(process.connections[0].ask({"do": "contents"})["answer"])
    except (ProcessEnded, Lost) as lost:
        raise Lost(f"seed {seed}, killed at {call} {number}: {str(lost) or 'the directory does not open'}") from lost
    finally:
        process.kill()
        process.close()
    subprocess.run(["rm", "-r", str(directory)], check=True)
    return met, worker.done


def _run(
    processes: StorageProcesses, directory: Path, tracer: list[str], seed: object, may_be_killed: bool
) -> tuple[Worker, bool]:
    worker, died = Worker(seed, 0), False
    process = processes.begin(directory, waiting=True)
    tracing = attach(process, tracer, directory.parent / "strace.log")
    try:
        for _ in range(OPERATIONS):
            worker.acknowledge(process.connections[0].ask(worker.next()))
    except ProcessEnded as ended:
        if not may_be_killed:
            raise Lost(f"the process ended by itself: {directory.parent / 'log'}") from ended
        died = True
    finally:
        process.kill()
        process.close()
        tracing.wait(60)
    return worker, died
