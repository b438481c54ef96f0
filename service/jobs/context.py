"""Running jobs: their context (progress, notes, cancellation), and encoding that lets requests go first."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from core.errors import UnknownMap
from core.frames.masks import Mask
from core.store import Map, Store
from service.engine.encoders import Encoded
from service.engine.engine import Engine
from service.engine.queue import RequestDeadline
from service.errors.faults import ClientGone
from service.jobs.job import Job

Work = Callable[["JobContext"], Mapping[str, Any]]
"""The function of a job; it returns the job's result as a JSON object."""

NOTICE_SECONDS = 0.1
"""Watchers of a job are notified of its progress at most once in this time."""

WRITING_SECONDS = 2.0
"""The progress of a job is written to disk at most once in this time; its end is always written."""

SLICE_SECONDS = 5.0
"""A resumable job works for this time before it gives way to waiting jobs of other maps."""


class JobCancelled(Exception):
    """Raised in a job that was cancelled.  The job undoes what must not stay half done, and lets it propagate."""


class JobInterrupted(Exception):
    """Raised in a job because the service stops.  The job lets it propagate; a resumable job goes on later."""


class JobGivesWay(Exception):
    """Raised in a job whose time slice is over while others wait.  The job lets it propagate, and goes on later."""


class Supervisor(Protocol):
    """The part of :class:`service.jobs.jobs.Jobs` that a job context uses."""

    def get(self, job_id: str) -> Job: ...
    def interrupts(self, job_id: str) -> bool: ...
    def others_wait(self, job_id: str) -> bool: ...
    def report(self, job_id: str, writing: bool, noticing: bool, **progress: Any) -> None: ...
    def note(self, job_id: str, notes: Mapping[str, Any]) -> None: ...


class JobContext:
    """The interface between a running job and the service; it is used in the job's thread.

    id, map_id, arguments, attempt, maps: as in :class:`service.jobs.job.Job`.
    notes: the notes of :meth:`remember`, also of an earlier attempt.
    """

    def __init__(self, jobs: Supervisor, job: Job) -> None:
        self._jobs, self._written, self._noticed = jobs, time.monotonic(), 0.0
        self._began = time.monotonic()
        self.id, self.map_id, self.arguments = job.id, job.map_id, job.arguments
        self.attempt = job.attempt
        self.notes = job.notes
        self.maps = job.maps

    def map(self, store: Store, map_id: str | None = None) -> Map:
        """One of the job's maps: the one with id ``map_id``, or by default the map that the job works on.

        Raises:
            UnknownMap: the map was deleted since the job was submitted, even if another one has its id now.
            MapQuarantined: the map is damaged.
            StorageFailure: the map cannot be read.
        """
        name = str(self.map_id) if map_id is None else map_id
        found = store.get(name)
        if name in self.maps and self.maps[name] != creation_time(found):
            raise UnknownMap(
                f"The map {name!r} was deleted after the job was submitted; the map of that id is now another one."
            )
        return found

    def progress(self, done: int, total: int | None = None, message: str = "") -> None:
        """Report how far the job is.  This is cheap: call it at every step.

        Args:
            done: steps that are done.
            total: all steps; None while their number is not known.
            message: the present step of the job; at most 500 characters are stored.
        """
        now = time.monotonic()
        writing, noticing = now - self._written >= WRITING_SECONDS, now - self._noticed >= NOTICE_SECONDS
        self._written = now if writing else self._written
        self._noticed = now if noticing else self._noticed
        self._jobs.report(self.id, writing, noticing, done=done, total=total, message=message[:500])

    def remember(self, **notes: Any) -> None:
        """Add notes (JSON values) for the next attempt of the job; they are on disk when this returns.

        Raises:
            StorageFull, StorageFailure: the disk is full or refuses.
        """
        self.notes = {**self.notes, **notes}
        self._jobs.note(self.id, self.notes)

    @property
    def cancelled(self) -> bool:
        """Whether the job was cancelled."""
        return self._jobs.get(self.id).cancelling

    @property
    def is_to_stop(self) -> bool:
        """Whether the job was cancelled, or has to go on later."""
        return self._jobs.interrupts(self.id) or self.cancelled

    def check_cancelled(self) -> None:
        """Raise if the job has to stop.

        Raises:
            JobCancelled: the job was cancelled.
            JobInterrupted: the service is stopping, or has lost the job to another one.
        """
        if self._jobs.interrupts(self.id):
            raise JobInterrupted
        if self.cancelled:
            raise JobCancelled

    def give_way(self) -> None:
        """Let waiting jobs of other maps run, if this one has had its time slice.

        Only resumable jobs call this, at points where nothing is half done.

        Raises:
            JobGivesWay: other jobs run first.
        """
        if time.monotonic() - self._began >= SLICE_SECONDS and self._jobs.others_wait(self.id):
            raise JobGivesWay

    def pause(self, seconds: float) -> None:
        """Sleep for some seconds; raises like :meth:`check_cancelled`, as soon as the job has to stop."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self.check_cancelled()
            time.sleep(min(left, 0.05))
        self.check_cancelled()


def creation_time(map_: Map) -> str:
    """When a map was created, as ISO 8601; it distinguishes the map from later ones of the same id."""
    return map_.record.created_at.isoformat()


Result = TypeVar("Result")

POLL_SECONDS = 0.2
"""A job that has to stop withdraws its waiting frames within this time."""

TOGETHER = 16
"""Steps of a computation, such as queries, between which requests go first."""

YIELD_SECONDS = 1.0
"""A job holds its frames back while requests wait for the encoder, but no longer than this, so that it ends."""

LONGEST_SECONDS = 3600.0
"""The longest time that the frames of a job wait for the encoder."""


def yield_to_requests(engine: Engine, context: JobContext) -> None:
    """Wait while requests wait for the encoder, for at most ``YIELD_SECONDS``.

    Raises:
        JobCancelled, JobInterrupted: the job has to stop.
    """
    until = time.monotonic() + YIELD_SECONDS
    context.check_cancelled()
    while engine.queue.waiting and time.monotonic() < until:
        context.pause(0.01)


def progress_of(engine: Engine, context: JobContext, message: str = "") -> Callable[[int, int], None]:
    """Make the function that a computation calls after each of its steps, with those done and all, to be a good job.

    It reports the progress, ends the job that has to stop, and lets requests go first now and then.

    Args:
        message: as of :meth:`JobContext.progress`.

    Raises (the function):
        JobCancelled, JobInterrupted: the job has to stop.
    """

    def advance(done: int, total: int) -> None:
        context.progress(done, total, message)
        context.check_cancelled()
        if done % TOGETHER == 0:
            yield_to_requests(engine, context)

    return advance


def run_after_requests(
    engine: Engine, context: JobContext, work: Callable[[RequestDeadline], Coroutine[Any, Any, Result]]
) -> Result:
    """Let waiting requests go first, then run a coroutine on the event loop; blocks the job's thread.

    Args:
        work: is called with a deadline that ends when the job has to stop.

    Raises:
        JobCancelled, JobInterrupted: the job has to stop.
        Others: the exceptions of the coroutine.
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
    engine: Engine,
    context: JobContext,
    identity: str,
    frames: Sequence[bytes],
    masks: Sequence[Mask | None],
    keypoints: bool = False,
) -> list[Encoded | Exception]:
    """Encode the frames of a job after the requests that wait; blocks the job's thread.

    The frames need no place in the queue, which is for requests, and wait like bulk frames.

    Args:
        identity: the identity of the encoder.
        frames: the bytes of the files.
        masks: for each frame the part that is ignored.
        keypoints: whether the frames' keypoints are wanted, too.

    Returns:
        For each frame its encoding, without the pixels, or the error that prevented it.

    Raises:
        JobCancelled, JobInterrupted: the job has to stop.
        EncoderNotInstalled: the encoder is not installed.
    """

    async def encode(deadline: RequestDeadline) -> list[Encoded | Exception]:
        return await engine.encode_all(identity, frames, deadline, masks, keypoints=keypoints)

    return run_after_requests(engine, context, encode)
