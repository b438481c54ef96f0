"""Long work: done in the background, told as it goes on, remembered over a restart.

A job is a function that runs in a worker's thread.  Of a kind that is registered (:meth:`Jobs.register`) it is made
again from its arguments after a restart; of any other it is then said to have failed, and why.  Whether a job stops
when it is asked to lies with it: it calls :meth:`JobContext.check_cancelled` where it can stop.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from core.errors import PlacerecError
from service.access.audit import note_job, now_asking
from service.errors.faults import JobEnded, JobLost, JobQueueFull, TooManyWatchers, UnknownJob
from service.errors.problems import problem_of
from service.jobs.context import NOTICE_SECONDS, JobCancelled, JobContext, JobGivesWay, JobInterrupted, Work
from service.jobs.records import DAMAGED, Job, JobRecords

__all__ = ["NOTICE_SECONDS", "JobCancelled", "JobContext", "JobInterrupted", "Jobs", "Work"]

MOST_RESULT_BYTES = 4 << 20
"""Of a result as JSON."""

Discard = Callable[[Job], None]
"""Clears away what a job had for itself, once it has ended in whatever way."""

log = logging.getLogger("placerec.jobs")


class Jobs:
    """All jobs of a data directory.  From any thread; reading never waits for a disk.

    Args:
        directory: that of the data, held by this process.
        workers: jobs that run at one time; of one map at most one runs.
        longest_queue: jobs that may wait.
        history: jobs that have ended and are still told.
        most_watchers: that may follow jobs at one time.

    Raises:
        DataDirectoryTooNew, StorageFull, StorageFailure.
    """

    def __init__(
        self,
        directory: Path,
        workers: int = 1,
        longest_queue: int = 32,
        history: int = 200,
        most_watchers: int = 64,
    ) -> None:
        self._workers, self._longest_queue, self._history = workers, longest_queue, history
        self._most_watchers = most_watchers
        self.stopping = False
        self._changed = threading.Condition()  # held by whoever changes a job
        self._records = JobRecords(directory)
        self._kinds: dict[str, Work] = {}
        self._discards: dict[str, Discard] = {}
        self._numbers = itertools.count(1)
        self._gave_way: dict[str, tuple[int, int]] = {}  # behind whom a job waits that has given way
        self._works: dict[str, Work] = {}
        self._jobs = {job.id: job for job in self._records.read()}
        self._last_number = self._records.last_number()
        self._watchers: list[tuple[str, asyncio.AbstractEventLoop, asyncio.Event]] = []
        self._threads: list[threading.Thread] = []

    # Kinds, start and end

    def register(self, kind: str, work: Work, discard: Discard | None = None) -> None:
        """Name a kind of job that can be begun anew: ``work`` does what ``context.arguments`` say, from any state
        that an earlier attempt left; ``discard`` clears away what the job had for itself."""
        self._kinds[kind] = work
        if discard is not None:
            self._discards[kind] = discard

    def start(self) -> None:
        """Take up what an earlier process left, and work; call it when all kinds are registered."""
        for job in [job for job in self.all() if not job.ended]:
            if job.resumable and job.kind in self._kinds:
                self._works[job.id] = self._kinds[job.kind]
                if job.state == "running":
                    self._change(job.id, state="queued", message="waits to go on after a restart of the service")
                continue
            was = "ran" if job.state == "running" else "waited"
            why = "this kind of job cannot be taken up again"
            if job.message == DAMAGED:
                why = DAMAGED
            elif job.resumable:
                why = f"this version of placerec knows no jobs of the kind {job.kind}"
            self._end(job.id, "failed", problem=_problem(JobLost(f"The service ended while the job {was}, and {why}.")))
            self._discard(job)
        for number in range(self._workers):
            thread = threading.Thread(target=self._work, name=f"job-{number}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def stop_soon(self) -> None:
        """Ask what runs to stop where it can, and let those who watch go; returns at once."""
        with self._changed:
            self.stopping = True
            self._changed.notify_all()
        self._notify(None)

    def close(self, timeout: float = 10.0) -> None:
        """Stop, and wait at most ``timeout`` seconds for running jobs; those that go on count as killed."""
        self.stop_soon()
        until = time.monotonic() + timeout
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))
            if thread.is_alive():
                log.warning("a job does not stop; it is left behind")
        self._records.close()

    # For those who ask

    def submit(
        self,
        kind: str,
        map_id: str | None,
        work: Work | None = None,
        arguments: Mapping[str, Any] | None = None,
        maps: Mapping[str, str] | None = None,
    ) -> Job:
        """Let a job wait for its turn; it is on disk when this returns.

        Args:
            work: what it does; without it the kind is a registered one, which survives a restart.
            arguments: for the work, as JSON.
            maps: those that it is asked for, by id, and when each was created (``creation_time``): the job fails
                rather than to work on a later one of the same id.

        Raises:
            JobQueueFull: too many wait.
            StorageFull, StorageFailure: it was not taken.
        """
        resumable = work is None
        chosen = self._kinds[kind] if work is None else work
        with self._changed:
            self.check_room()
            job = Job(
                number=self._last_number + 1,
                id=secrets.token_hex(8),
                kind=kind,
                map_id=map_id,
                arguments=dict(arguments or {}),
                resumable=resumable,
                created_at=datetime.now(UTC),
                maps=dict(maps or {}),
                asker=now_asking(),
            )
            self._records.put(job)
            self._last_number = job.number
            self._works[job.id], self._jobs[job.id] = chosen, job
            self._changed.notify_all()
        log.info("job queued", extra={"job": job.id, "kind": kind, "map": map_id})
        return job

    def check_room(self) -> None:
        """Raise JobQueueFull if no further job may wait; for before a long body is read."""
        if sum(job.state == "queued" for job in self._jobs.copy().values()) >= self._longest_queue:
            raise JobQueueFull(f"{self._longest_queue} jobs wait already; send this one again later.")

    @property
    def watchers(self) -> int:
        """Clients that follow jobs now."""
        return len(self._watchers)

    def get(self, job_id: str) -> Job:
        """A job as it is now.

        Raises:
            UnknownJob: there is none, or it ended so long ago that it is forgotten.
        """
        found = self._jobs.get(job_id)
        if found is None:
            aside = self._records.put_aside
            more = "" if aside is None else f" The records of earlier jobs were damaged; they are put aside as {aside}."
            raise UnknownJob(f"There is no job {job_id[:80]!r}.{more}")
        return found

    def all(self) -> list[Job]:
        """Those that are remembered, the oldest first."""
        return sorted(self._jobs.copy().values(), key=lambda job: job.number)

    def cancel(self, job_id: str) -> Job:
        """Ask a job to stop.  One that waits is cancelled at once, one that runs when it gets to where it can stop.

        Raises:
            UnknownJob: there is none.
            JobEnded: it has succeeded or failed.
            StorageFull, StorageFailure: it was not asked.
        """
        with self._changed:
            job = self.get(job_id)
            if job.state in ("succeeded", "failed"):
                raise JobEnded(f"The job {job_id} has {job.state} already.")
            if ended := job.state == "queued" and (not job.attempt or job_id in self._gave_way):
                job = self._end(job_id, "cancelled")
            elif job.state != "cancelled" and not job.cancelling:
                changed = replace(job, cancelling=True, change=job.change + 1)
                self._records.update(changed)
                self._jobs[job_id] = changed
        if ended:
            self._discard(job)
            return job
        self._notify(job_id)
        return self.get(job_id)

    @contextmanager
    def watching(self, job_id: str) -> Iterator[asyncio.Event]:
        """An event of the running loop that is set whenever the job has changed, or the service stops.

        Raises:
            TooManyWatchers.
        """
        if len(self._watchers) >= self._most_watchers:
            raise TooManyWatchers("Too many follow jobs already; read the job instead, or come again later.")
        watcher = (job_id, asyncio.get_running_loop(), asyncio.Event())
        self._watchers.append(watcher)
        try:
            yield watcher[2]
        finally:
            self._watchers.remove(watcher)

    # The workers

    def _work(self) -> None:
        while (job := self._take()) is not None:
            if job.id not in self._gave_way:  # else that it began was told
                note_job(job, "running")
            try:
                self._do(job)
            except Exception:  # a defect of ours: the job is told as failed, and the worker goes on
                log.exception("job %s failed", job.id)
                self._end(job.id, "failed", problem=_problem(RuntimeError()))

    def _do(self, job: Job) -> None:
        began = time.perf_counter()
        context = JobContext(self, job)
        try:
            result = dict(self._works[job.id](context))
            if len(json.dumps(result, allow_nan=False)) > MOST_RESULT_BYTES:
                raise ValueError("the result is too long to be kept")
        except JobCancelled:
            ended = self._end(job.id, "cancelled")
        except JobInterrupted:
            ended = self._put_off(job)
        except JobGivesWay:
            self._gave_way[job.id] = (self._last_number, next(self._numbers))
            ended = self._change(job.id, state="queued", message="waits for others to have their turn")
            with self._changed:
                self._changed.notify_all()
        except Exception as error:
            problem = _problem(error)
            if problem["status"] == 500:
                log.exception("job %s failed", job.id)
            ended = self._end(job.id, "failed", problem=problem)
        else:
            ended = self._end(job.id, "succeeded", result=result)
        if ended.ended:
            self._discard(ended)
        seconds = round(time.perf_counter() - began, 2)
        log.info("job %s", ended.state, extra={"job": job.id, "kind": job.kind, "map": job.map_id, "seconds": seconds})

    def _take(self) -> Job | None:
        """The next job, which runs from now on; waits for one; None when the service stops."""
        with self._changed:
            while not self.stopping:
                for job in self._ready():
                    now = datetime.now(UTC)
                    return self._change(job.id, state="running", attempt=job.attempt + 1, started_at=now)
                self._changed.wait()
        return None

    def _ready(self, but_for: str | None = None) -> list[Job]:
        """Jobs that may run now, in their order; those of one map run one after another, as they were asked for."""
        first: dict[str | None, int] = {}
        for job in (open_ := [job for job in self.all() if not job.ended and job.id != but_for]):
            first.setdefault(job.map_id, job.number)
        ready = [
            job
            for job in open_
            if job.state == "queued"
            and job.id in self._works
            and (job.map_id is None or first[job.map_id] == job.number)
        ]
        return sorted(ready, key=lambda job: self._gave_way.get(job.id, (job.number, 0)))

    def others_wait(self, job_id: str) -> bool:
        """Whether jobs of other maps wait that could run if this one gave way."""
        with self._changed:
            own = self._jobs[job_id].map_id
            return any(job.map_id is None or job.map_id != own for job in self._ready(job_id))

    def _put_off(self, job: Job) -> Job:
        if job.resumable:
            return self._change(job.id, state="queued", message="goes on when the service starts again")
        why = "The service was stopped while the job ran, and this kind of job cannot be taken up again."
        return self._end(job.id, "failed", problem=_problem(JobLost(why)))

    def _discard(self, job: Job) -> None:
        if (discard := self._discards.get(job.kind)) is not None:
            try:
                discard(job)
            except Exception as error:  # what is left is cleared away at the next start
                log.warning("what the job %s had cannot be cleared away: %s", job.id, error)

    # Changes

    def report(self, job_id: str, writing: bool, noticing: bool, **progress: Any) -> None:
        if writing:
            self._change(job_id, **progress)
            return
        with self._changed:
            job = self._jobs[job_id]
            if {name: getattr(job, name) for name in progress} != progress:
                self._jobs[job_id] = replace(job, change=job.change + 1, **progress)
        if noticing:
            self._notify(job_id)

    def note(self, job_id: str, notes: Mapping[str, Any]) -> None:
        with self._changed:
            job = replace(self._jobs[job_id], notes=dict(notes))
            self._records.put(job)
            self._jobs[job_id] = job

    def _end(self, job_id: str, state: str, **outcome: Any) -> Job:
        """The end of a job, before which the oldest that have ended are forgotten."""
        with self._changed:
            past = [job for job in self.all() if job.ended]
            past = past[: max(0, len(past) + 1 - self._history)]
            for job in past:
                del self._jobs[job.id]
            ended = self._change(job_id, state=state, ended_at=datetime.now(UTC), notes={}, **outcome)
            note_job(ended, state)
            self._works.pop(job_id, None)
            self._gave_way.pop(job_id, None)
            self._changed.notify_all()  # another one of the same map may run
            if past:
                with suppress(PlacerecError):  # they are forgotten at another time
                    self._records.forget([job.number for job in past])
        return ended

    def _change(self, job_id: str, **changes: Any) -> Job:
        """Another state; a disk that refuses to keep it does not end the work."""
        with self._changed:
            before = self._jobs[job_id]
            change = 0 if "attempt" in changes else before.change + 1
            job = self._jobs[job_id] = replace(before, change=change, **changes)
            try:
                (self._records.put if "notes" in changes else self._records.update)(job)
            except Exception as error:
                log.error("job %s cannot be written down: %s", job_id, error)
        self._notify(job_id)
        return job

    def _notify(self, job_id: str | None) -> None:
        """Wake those who watch a job; all for None."""
        for watched, loop, event in self._watchers.copy():
            if job_id in (None, watched):
                with suppress(RuntimeError):  # its loop has ended
                    loop.call_soon_threadsafe(event.set)


def _problem(error: Exception) -> dict[str, Any]:
    return problem_of(error).model_dump(exclude_none=True)
