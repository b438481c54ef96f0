"""A job from within: how it says how far it is, what it remembers, and how it learns that it is to stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from service.job_records import Job

if TYPE_CHECKING:
    from service.jobs import Jobs

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


class JobContext:
    """What a job knows of itself while it runs, in the thread that runs it."""

    def __init__(self, jobs: Jobs, job: Job) -> None:
        self._jobs, self._written, self._noticed = jobs, time.monotonic(), 0.0
        self.id, self.map_id, self.arguments = job.id, job.map_id, job.arguments
        self.attempt = job.attempt
        self.notes = job.notes

    def progress(self, done: int, total: int | None = None, message: str = "") -> None:
        """Say how far the job is; cheap enough to be called at every step."""
        now = time.monotonic()
        writing, noticing = now - self._written >= WRITING_SECONDS, now - self._noticed >= NOTICE_SECONDS
        self._written = now if writing else self._written
        self._noticed = now if noticing else self._noticed
        self._jobs._progress(self.id, writing, noticing, done=done, total=total, message=message[:500])

    def remember(self, **notes: Any) -> None:
        """Write down, on disk when this returns, what the next attempt needs besides the arguments; JSON.

        Raises:
            StorageFull, StorageFailure.
        """
        self.notes = {**self.notes, **notes}
        self._jobs._note(self.id, self.notes)

    @property
    def cancelled(self) -> bool:
        """Somebody has asked the job to stop."""
        return self._jobs.get(self.id).cancelling

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

    def pause(self, seconds: float) -> None:
        """Do nothing for a while; raises like :meth:`check_cancelled`, without waiting for the end."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self.check_cancelled()
            time.sleep(min(left, 0.05))
        self.check_cancelled()
