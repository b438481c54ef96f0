"""Those who follow jobs: clients of this service, and the listeners of the maps that jobs use."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from service.access.audit import asker_of_fields
from service.errors.faults import TooManyWatchers
from service.events.events import Events
from service.events.schemas import JobEvent
from service.fairness import Holding, SharedRoom
from service.jobs.job import Job

TELLING_SECONDS = 1.0
"""The shortest time between two events of a job's progress."""


class JobChanged(asyncio.Event):
    """Is set when a job has changed, or when its watcher has to go; ``over`` says that."""

    over = False

    def give_way(self) -> bool:
        """Let the watcher go, so that another caller can follow jobs."""
        self.over = True
        self.set()
        return True


class Watchers:
    """Those who follow jobs.  Any thread may notify them.

    Args:
        most: how many clients may follow jobs at one time.
        events: receives the progress of jobs; None: it is not published.
    """

    def __init__(self, most: int, events: Events | None) -> None:
        self._room, self._events = SharedRoom(most), events
        self._published: dict[str, tuple[str, float]] = {}  # of running jobs: the state published last, and when
        self._watching: list[tuple[str, asyncio.AbstractEventLoop, JobChanged]] = []

    def __len__(self) -> int:
        return self._room.held

    @contextmanager
    def watching(self, job_id: str) -> Iterator[JobChanged]:
        """An event of the running loop that is set whenever the job changes, or when the service stops.

        If too many follow jobs, the latest of the caller that has most of them has to go.

        Raises:
            TooManyWatchers: too many clients follow jobs already.
        """
        watcher = (job_id, asyncio.get_running_loop(), JobChanged())
        holding = Holding(watcher[2].give_way)
        if not self._room.take(holding):
            raise TooManyWatchers("Too many clients follow jobs already; read the job instead, or try again later.")
        self._watching.append(watcher)
        try:
            yield watcher[2]
        finally:
            self._watching.remove(watcher)
            self._room.release(holding)

    def wake(self, job_id: str | None) -> None:
        """Wake the clients that follow a job; all clients for None."""
        for watched, loop, event in self._watching.copy():
            if job_id in (None, watched):
                with suppress(RuntimeError):  # its loop has ended
                    loop.call_soon_threadsafe(event.set)

    def notify(self, job: Job) -> None:
        """Wake the clients that follow a job, and publish its state; mere progress at most once in a while."""
        self._publish(job)
        self.wake(job.id)

    def _publish(self, job: Job) -> None:
        used, events = job.used_maps(), self._events
        if events is None or not any(events.heard(name) for name in used if name is not None):
            self._published.pop(job.id, None)
            return
        state, now = f"{job.state} {job.cancelling}", time.monotonic()
        published, moment = self._published.get(job.id, ("", 0.0))
        if published == state and now - moment < TELLING_SECONDS:
            return
        self._published[job.id] = (state, now)
        if job.ended:
            self._published.pop(job.id, None)
        for name in used - {None}:
            events.publish(_event(str(name), job), maps=frozenset(used))


def _event(map_id: str, job: Job) -> JobEvent:
    return JobEvent.now(
        map_id,
        asker_of_fields(job.asker),
        job=job.id,
        job_kind=job.kind,
        state=job.state,
        progress={"done": job.done, "total": job.total, "message": job.message},
        cancelling=job.cancelling,
        problem=job.problem,
    )
