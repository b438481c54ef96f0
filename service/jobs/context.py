"""A job from within: how it says how far it is, what it remembers, and how it learns that it is to stop."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from core.errors import UnknownMap
from core.frames.masks import Mask
from core.storage import Atlas, Map
from service.engine.engine import Engine
from service.engine.queue import Encoded, RequestDeadline
from service.errors.faults import ClientGone
from service.jobs.records import Job

Work = Callable[["JobContext"], Mapping[str, Any]]
"""What a job does; its result is an object of JSON."""

NOTICE_SECONDS = 0.1
"""Those who watch a job are told of its progress at most so often."""

WRITING_SECONDS = 2.0
"""Its progress is written down at most so often; how it ends always is."""


class JobCancelled(Exception):
    """Raised within a job that somebody asked to stop; it undoes what must not stay, and lets it pass."""


class JobInterrupted(Exception):
    """Raised within a job because the service stops; it lets it pass, and goes on at the next start if it can."""


class JobGivesWay(Exception):
    """Raised within a job because others wait and it has had its share of time: it lets it pass, and goes on later."""


SLICE_SECONDS = 5.0
"""So long a job that can be taken up again works before it gives way to those that wait."""


class Supervisor(Protocol):
    """What a job reports to, and asks whether it is to stop: all jobs together (:class:`service.jobs.jobs.Jobs`)."""

    stopping: bool

    def get(self, job_id: str) -> Job: ...
    def others_wait(self, job_id: str) -> bool: ...
    def report(self, job_id: str, writing: bool, noticing: bool, **progress: Any) -> None: ...
    def note(self, job_id: str, notes: Mapping[str, Any]) -> None: ...


class JobContext:
    """What a job knows of itself while it runs, in the thread that runs it."""

    def __init__(self, jobs: Supervisor, job: Job) -> None:
        self._jobs, self._written, self._noticed = jobs, time.monotonic(), 0.0
        self._began = time.monotonic()
        self.id, self.map_id, self.arguments = job.id, job.map_id, job.arguments
        self.attempt = job.attempt
        self.notes = job.notes
        self.maps = job.maps

    def map(self, atlas: Atlas, map_id: str | None = None) -> Map:
        """One of the maps that the job was asked for, its own one unless another is named.

        Raises:
            UnknownMap: it was deleted, though another one may have been created under its id.
            MapQuarantined, StorageFailure.
        """
        name = str(self.map_id) if map_id is None else map_id
        found = atlas.get(name)
        if name in self.maps and self.maps[name] != creation_time(found):
            raise UnknownMap(
                f"The map {name!r} was deleted since the job was asked for; the one of that id now is another."
            )
        return found

    def progress(self, done: int, total: int | None = None, message: str = "") -> None:
        """Say how far the job is; cheap enough to be called at every step."""
        now = time.monotonic()
        writing, noticing = now - self._written >= WRITING_SECONDS, now - self._noticed >= NOTICE_SECONDS
        self._written = now if writing else self._written
        self._noticed = now if noticing else self._noticed
        self._jobs.report(self.id, writing, noticing, done=done, total=total, message=message[:500])

    def remember(self, **notes: Any) -> None:
        """Write down, on disk when this returns, what the next attempt needs besides the arguments; JSON.

        Raises:
            StorageFull, StorageFailure.
        """
        self.notes = {**self.notes, **notes}
        self._jobs.note(self.id, self.notes)

    @property
    def cancelled(self) -> bool:
        """Somebody has asked the job to stop."""
        return self._jobs.get(self.id).cancelling

    @property
    def is_to_stop(self) -> bool:
        """Whether the job was cancelled, or the service stops."""
        return self._jobs.stopping or self.cancelled

    def check_cancelled(self) -> None:
        """Return unless the job is to stop.

        Raises:
            JobCancelled: it was asked to.
            JobInterrupted: the service stops.
        """
        if self._jobs.stopping:
            raise JobInterrupted
        if self.cancelled:
            raise JobCancelled

    def give_way(self) -> None:
        """Let jobs of other maps have their turn, if any wait and this one has worked for a while; for jobs that can be
        taken up again, called where nothing is half done.

        Raises:
            JobGivesWay: they go first.
        """
        if time.monotonic() - self._began >= SLICE_SECONDS and self._jobs.others_wait(self.id):
            raise JobGivesWay

    def pause(self, seconds: float) -> None:
        """Do nothing for a while; raises like :meth:`check_cancelled`, without waiting for the end."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self.check_cancelled()
            time.sleep(min(left, 0.05))
        self.check_cancelled()


def creation_time(map_: Map) -> str:
    """What tells a map from later ones of the same id: when it was created."""
    return map_.record.created_at.isoformat()


Result = TypeVar("Result")

POLL_SECONDS = 0.2
"""A job that is to stop gives its frames up within this time."""

YIELD_SECONDS = 1.0
"""While requests wait for the encoder a job holds its frames back, but not for longer: it is to end some day."""

LONGEST_SECONDS = 3600.0


def yield_to_requests(engine: Engine, context: JobContext) -> None:
    """Wait while requests wait for the encoder, up to a bound.

    Raises:
        JobCancelled, JobInterrupted.
    """
    until = time.monotonic() + YIELD_SECONDS
    context.check_cancelled()
    while engine.queue.waiting and time.monotonic() < until:
        context.pause(0.01)


def run_after_requests(
    engine: Engine, context: JobContext, work: Callable[[RequestDeadline], Coroutine[Any, Any, Result]]
) -> Result:
    """Run a coroutine that waits for the encoder, behind the requests that wait for it; blocks the job's thread.

    Args:
        work: what to run, with the deadline of the job: it ends when the job is to stop.

    Raises:
        JobCancelled, JobInterrupted.
    """

    async def stopped() -> None:
        while not context.is_to_stop:
            await asyncio.sleep(POLL_SECONDS)

    yield_to_requests(engine, context)
    deadline = RequestDeadline(time.monotonic() + LONGEST_SECONDS, stopped)
    try:
        return asyncio.run_coroutine_threadsafe(work(deadline), engine.loop).result()
    except ClientGone:
        context.check_cancelled()
        raise


def encode_after_requests(
    engine: Engine, context: JobContext, identity: str, frames: Sequence[bytes], masks: Sequence[Mask | None]
) -> list[Encoded | Exception]:
    """What becomes of frames, in their order, without their pixels; blocks the job's thread.

    They take no place in the queue, which is for requests, and join forward passes as bulk does.

    Raises:
        JobCancelled, JobInterrupted.
    """

    async def encode(deadline: RequestDeadline) -> list[Encoded | Exception]:
        return await engine.encode_all(identity, frames, deadline, masks)

    return run_after_requests(engine, context, encode)
