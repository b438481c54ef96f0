"""Services without HTTP that do jobs: one that is alone, and those that share their jobs in a PostgreSQL."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Protocol

from service.jobs.context import JobContext
from service.jobs.job import Job
from service.jobs.jobs import Jobs
from service.peers.replica import ServiceReplica
from service.shared.database import SharedDatabase

Kinds = Mapping[str, Callable[[JobContext], Mapping[str, Any]]]


class Running(Protocol):
    """Jobs of a folder that run as long as the block."""

    def __call__(self, folder: Path, kinds: Kinds | None = None, **limits: Any) -> AbstractContextManager[Jobs]: ...


@contextmanager
def running_alone(folder: Path, kinds: Kinds | None = None, **limits: Any) -> Iterator[Jobs]:
    """The jobs of a service that is alone."""
    jobs = Jobs.of_directory(folder, **limits)
    for kind, work in (kinds or {}).items():
        jobs.register(kind, work)
    jobs.start()
    try:
        yield jobs
    finally:
        jobs.close(timeout=30)


class Service:
    """The jobs of one of the services that share them."""

    def __init__(self, address: str, folder: Path, kinds: Kinds, shared_maps: bool = True, **limits: Any) -> None:
        folder.mkdir(exist_ok=True)
        self.database = SharedDatabase(address)
        self.replica = ServiceReplica(self.database, folder)
        self.jobs = Jobs(self.database, self.replica, shared_maps, **limits)
        for kind, work in kinds.items():
            self.jobs.register(kind, work)

    def start(self) -> Service:
        self.replica.start()
        self.jobs.start()
        return self

    def close(self) -> None:
        self.jobs.close(30)
        self.replica.close()
        self.database.close()

    def fall_silent(self) -> None:
        """Neither say that it is there nor hear anything any more, as if it was stopped for a while."""
        self.replica._stopping.set()
        for thread in self.replica._threads:
            thread.join()


def end_of(jobs: Jobs, job: Job) -> Job:
    """A job that has ended."""
    until = time.monotonic() + 60
    while not (found := jobs.get(job.id)).ended:
        assert time.monotonic() < until, found
        time.sleep(0.005)
    return found


class Gate:
    """Work that says when it has begun, and goes on when it is let."""

    def __init__(self) -> None:
        self.begun, self.open = threading.Event(), threading.Event()

    def __call__(self, context: JobContext) -> dict[str, Any]:
        context.progress(1, 4, "at the gate")
        self.begun.set()
        while not self.open.is_set():
            context.pause(0.01)
        return {"passed": context.arguments}
