"""Jobs: the listing, and one job that is followed, waited for or cancelled."""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import aclosing, suppress
from datetime import timedelta
from typing import Any, Unpack

from placerec_client import models, parameters, problems
from placerec_client._async.connection import AsyncConnection
from placerec_client._async.following import follow
from placerec_client.answers import parsed, problem_of
from placerec_client.errors import DeadlineExceeded, JobCancelled
from placerec_client.renamed import Subscripted
from placerec_client.requests import path_of, seconds_of

OPEN = ("queued", "running")
WAIT_SECONDS = 20.0
"""How long one request waits for the end of a job; with a progress function, PROGRESS_SECONDS."""

PROGRESS_SECONDS = 1.0

Progress = Callable[[models.JobView], object]


class AsyncJobs(Subscripted):
    """The jobs of a service; iterated, the newest first."""

    def __init__(self, connection: AsyncConnection) -> None:
        self._connection = connection

    def __getitem__(self, job_id: str) -> AsyncJob:
        return AsyncJob(self._connection, job_id)

    def __aiter__(self) -> AsyncIterator[models.JobView]:
        return self.list()

    async def list(self, **options: Unpack[parameters.ListJobs]) -> AsyncIterator[models.JobView]:
        """Yield the jobs, the newest first; ``map``, ``kind`` and ``state`` choose among them."""
        async for page in self._connection.pages(models.JobPage, "/v1/jobs", dict(options)):
            for item in page.items:
                yield item


class AsyncJob:
    """One job.

    Attributes:
        id: of the job.
        view: the job as it was last seen; None before.
    """

    def __init__(self, connection: AsyncConnection, job_id: str, view: models.JobView | None = None) -> None:
        self._connection, self.id, self.view = connection, job_id, view
        self._path = path_of("jobs", job_id)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.id!r})"

    @classmethod
    async def submit(cls, connection: AsyncConnection, path: str, **options: Any) -> AsyncJob:
        """Ask for a job. If an answer was lost, the job that it was about is taken and the second one cancelled."""
        began = time.monotonic()
        response = await connection.request("POST", path, **options)
        view = parsed(models.JobView, response.content)
        if response.extensions.get("after_loss"):
            window = timedelta(seconds=time.monotonic() - began + 1)
            async for other in AsyncJobs(connection).list(kind=view.kind):
                same = (other.map, other.arguments) == (view.map, view.arguments) and other.id != view.id
                if same and view.created_at - window <= other.created_at <= view.created_at:
                    with suppress(problems.JobEnded):
                        await cls(connection, view.id).cancel()
                    view = other
        return cls(connection, view.id, view)

    async def read(self) -> models.JobView:
        """Return the job as it is now."""
        self.view = await self._connection.ask(models.JobView, "GET", self._path)
        return self.view

    async def wait(self, progress: Progress | None = None, *, deadline: float | None = None) -> models.JobView:
        """Wait until the job ends, over restarts of the service, and return it.

        Args:
            progress: is called with the job whenever it was seen.
            deadline: seconds to wait at most; the job goes on.

        Raises:
            Problem: the job has failed; the class is that of its problem.
            JobCancelled: it was cancelled.
            DeadlineExceeded: it has not ended in time.
        """
        until = None if deadline is None else time.monotonic() + seconds_of("deadline", deadline)
        step = WAIT_SECONDS if progress is None else PROGRESS_SECONDS
        while True:
            left = step if until is None else min(step, max(until - time.monotonic(), 0.0))
            self.view = job = await self._connection.ask(models.JobView, "GET", self._path, params={"wait": left})
            if progress is not None:
                progress(job)
            if job.state not in OPEN:
                return ended(job)
            if until is not None and time.monotonic() >= until:
                raise DeadlineExceeded(f"The job {self.id} has not ended within {deadline:g} s; it goes on.")

    async def cancel(self) -> models.JobView:
        """Ask the job to stop; it stops at its next safe point.

        Raises:
            JobEnded: it has ended already.
        """
        try:
            self.view = await self._connection.ask(models.JobView, "POST", self._path + "/cancel")
        except problems.JobEnded as problem:
            if not problem.after_loss or (await self.read()).state != "cancelled":
                raise
        assert self.view is not None
        return self.view

    async def events(self) -> AsyncGenerator[models.JobView]:
        """Yield the job whenever it has changed, until it has ended; a lost connection is taken up again."""
        async with aclosing(follow(self._connection, self._path + "/events", {})) as events:
            async for event in events:
                self.view = job = parsed(models.JobView, event.data)
                yield job
                if job.state not in OPEN:
                    return


def ended(job: models.JobView) -> models.JobView:
    """Return a job that has succeeded.

    Raises:
        Problem: it has failed.
        JobCancelled: it was cancelled.
    """
    if job.state == "failed":
        found = job.problem.model_dump(exclude_none=True) if job.problem else {"detail": f"The job {job.id} failed."}
        raise problem_of(found)
    if job.state == "cancelled":
        raise JobCancelled(job)
    return job
