"""The storage layer on a disk that loses power: at many moments, all that was not synced is lost, or a part of it."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from random import Random

from tests.durability.model import Lost, World, settled
from tests.durability.storage.kills import Worker, expect_erased
from tests.durability.storage.processes import ProcessEnded, StorageProcess, StorageProcesses
from tests.durability.traced_disk import VARIANTS, Disk, arguments

ATTACHING_SECONDS = 30.0


def attach(process: StorageProcess, tracer: list[str], log: Path) -> subprocess.Popen[bytes]:
    """Attach a tracer to a waiting process, then let the process go on."""
    with log.open("ab") as told:
        before = told.tell()
        tracing = subprocess.Popen([*tracer, "-p", str(process.number)], stderr=told)
    until = time.monotonic() + ATTACHING_SECONDS
    while b" attached" not in log.read_bytes()[before:]:  # it has stopped then, and goes on when the tracer lets it
        assert tracing.poll() is None and time.monotonic() < until, log.read_text()[-2000:]
        time.sleep(0.002)
    process.connections[0].begin()
    return tracing


@dataclass
class PowerTally:
    """Counts of a replay."""

    operations: int = 0
    writes: int = 0
    syncs: int = 0
    moments: int = 0
    disks: int = 0

    def __add__(self, other: PowerTally) -> PowerTally:
        return PowerTally(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(self)))


def record(processes: StorageProcesses, folder: Path, seed: object, operations: int) -> tuple[Path, list[World]]:
    """Trace a process that does random operations; the trace, and the world after each acknowledgement.

    Raises:
        Lost: an answer was wrong.
    """
    worker, trace = Worker(seed, 0), folder / "trace"
    worlds = [worker.candidates[0]]
    process = processes.begin(folder / "data", waiting=True)
    tracer = attach(process, arguments(trace), folder / "strace.log")
    try:
        for _ in range(operations):
            worker.acknowledge(process.connections[0].ask(worker.next()))
            worlds.append(worker.candidates[0])
    except ProcessEnded as ended:
        raise Lost(f"the process ended by itself: {folder / 'log'}") from ended
    finally:
        process.kill()
        process.close()
        tracer.wait(60)
    return trace, worlds


def told(sent: bytes) -> str | None:
    """An acknowledgement of the process."""
    return "ack" if sent.startswith(b"ack ") else None


def moments(disk: Disk, trace: Path) -> Iterator[int]:
    """After each change of the disk: how many operations were acknowledged."""
    acknowledged = 0
    with trace.open() as lines:
        for what in disk.replay(lines, told):
            acknowledged += what is not None
            yield acknowledged


def power(processes: StorageProcesses, folder: Path, seed: object, operations: int, disks: int) -> PowerTally:
    """Trace, cut the power at so many moments, and compare what is found.

    Raises:
        Lost: something that was acknowledged is not there, or something is half there.
    """
    trace, worlds = record(processes, folder, seed, operations)

    def look(image: Path, acknowledged: int) -> None:
        check(processes, image, worlds[acknowledged : acknowledged + 2])

    return cut(folder, seed, PowerTally(operations), disks, lambda disk: moments(disk, trace), look)


def cut(
    folder: Path,
    seed: object,
    tally: PowerTally,
    disks: int,
    moments: Callable[[Disk], Iterator[int]],
    look: Callable[[Path, int], None],
) -> PowerTally:
    """Cut the power at so many moments of a trace, and look at the disk that each leaves.

    Args:
        moments: replays the trace on a disk; after each change, how many operations were acknowledged.
        look: compares a disk with what so many acknowledged operations allow; raises Lost or ProcessEnded.

    Raises:
        Lost: something that was acknowledged is not there, or something is half there.
    """
    count = sum(1 for _ in moments(Disk(folder / "data")))
    random = Random(f"{seed}/power")
    chosen = set(random.sample(range(count), min(count, disks)))
    disk, image = Disk(folder / "data"), folder / "disk"
    for number, acknowledged in enumerate(moments(disk)):
        if number not in chosen:
            continue
        tally.moments += 1
        variant = VARIANTS[0] if random.random() < 0.4 else random.choice(VARIANTS[1:])
        shutil.rmtree(image, ignore_errors=True)
        disk.image(image, variant, Random(f"{seed}/disk/{number}"))
        try:
            look(image, acknowledged)
        except (ProcessEnded, Lost) as lost:
            why = str(lost) or "the directory does not open"
            raise Lost(f"seed {seed}, power cut at change {number}, {variant}: {why}") from lost
        tally.disks += 1
    tally.writes, tally.syncs = disk.writes, disk.syncs
    return tally


def check(processes: StorageProcesses, directory: Path, may: Sequence[World]) -> None:
    """Open a directory and compare all of it with the worlds that may be there.

    Raises:
        Lost: none of them is.
        ProcessEnded: it does not open.
    """
    expect_erased(directory, *may)
    process = processes.begin(directory)
    try:
        settled(may, process.connections[0].ask({"do": "contents"})["answer"])
    finally:
        process.kill()
        process.close()
