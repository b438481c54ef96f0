"""The whole service on a disk that loses power: its maps, its sessions and its jobs."""

from __future__ import annotations

import copy
import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from service.jobs.file import open_file
from service.sessions.table import SessionTable, session_file
from tests.durability.model import Lost, World
from tests.durability.server import operations as requests
from tests.durability.server.kills import PATIENCE, SETTINGS, Client
from tests.durability.server.processes import ServerProcesses
from tests.durability.storage.power_cuts import PowerTally, check, cut
from tests.durability.storage.processes import StorageProcesses
from tests.durability.traced_disk import Disk, arguments
from tests.service.encoders import install_coarse_encoder


@dataclass(frozen=True)
class Moment:
    """What must be found after a number of answers: the maps, and the session that is open."""

    world: World
    session: dict[str, Any] | None


def record(servers: ServerProcesses, folder: Path, seed: object, operations: int) -> tuple[Path, list[Moment]]:
    """Trace a service that answers random requests; its trace, and what must be found after each answer.

    Raises:
        Lost: an answer was wrong.
    """
    install_coarse_encoder(folder / "models")
    client, trace = Client(seed, 0, single=True), folder / "trace"
    moments = [Moment(client.candidates[0], None)]
    settings = {**SETTINGS, "data_dir": folder / "data", "models_dir": folder / "models"}
    server = servers.begin(settings, traced=True)
    with (folder / "strace.log").open("ab") as told:
        tracer = subprocess.Popen([*arguments(trace), "-p", str(server.number)], stderr=told)
    try:
        server.wait()
        with httpx.Client(base_url=server.client.base_url, timeout=PATIENCE) as own:
            for number in range(operations):
                operation = client.next()
                own.headers["X-Request-Id"] = f"op-{number}"
                client.acknowledge(operation, requests.send(own, operation))
                moments.append(Moment(client.candidates[0], copy.deepcopy(client.session)))
    finally:
        server.close()
        tracer.wait(60)
    return trace, moments


def told(sent: bytes) -> str | None:
    """The request whose answer begins to be sent."""
    if not sent.startswith(b"HTTP/1.1 "):
        return None
    found = re.search(rb"(?i)\r\nx-request-id: op-(\d+)\r\n", sent)
    return None if found is None else found[1].decode()


def answered(disk: Disk, trace: Path) -> Iterator[int]:
    """After each change of the disk: how many requests were answered."""
    count = 0
    with trace.open() as lines:
        for what in disk.replay(lines, told):
            count = count if what is None else int(what) + 1
            yield count


def power(
    servers: ServerProcesses, processes: StorageProcesses, folder: Path, seed: object, operations: int, disks: int
) -> PowerTally:
    """Trace, cut the power at so many moments, and compare what is found.

    Raises:
        Lost: something that was answered is not there, or something is half there.
    """
    trace, moments = record(servers, folder, seed, operations)

    def look(image: Path, answers: int) -> None:
        _check(processes, image, moments[answers : answers + 2])

    tally = cut(folder, seed, PowerTally(operations), disks, lambda disk: answered(disk, trace), look)
    if max(answered(Disk(folder / "data"), trace), default=0) != operations:
        raise Lost("the trace does not show every answer")
    return tally


def _check(processes: StorageProcesses, image: Path, may: list[Moment]) -> None:
    check(processes, image, [moment.world for moment in may])
    open_file(image)[0].close()
    file = session_file(image)
    found = {one.id: one.number or 0 for one in SessionTable(file).living()}
    file.close()
    if (image / "sessions.sqlite.damaged").exists():
        raise Lost("sessions.sqlite is damaged")
    sessions = [moment.session for moment in may]
    wanted = [{} if one is None else {one["id"]: one["last"]} for one in sessions]
    living = [{name: number for name, number in found.items() if name in one} for one in wanted]
    if not any(one == there for one, there in zip(wanted, living, strict=True)):
        raise Lost(f"sessions: one of {wanted} expected, {found} found")
